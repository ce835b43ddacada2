"""Robot files: how an MJCF or a URDF becomes a `Model`, and a `Model` an MJCF or the
numbers of the user's own file; bundled scenes."""

from rbjax.loading.builder import ModelBuilder
from rbjax.loading.loader import compile_model, load, scenes
from rbjax.loading.write.back import write_back
from rbjax.loading.write.mjcf import write_mjcf

__all__ = ["ModelBuilder", "compile_model", "load", "scenes", "write_back", "write_mjcf"]
