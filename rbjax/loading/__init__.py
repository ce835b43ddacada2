"""Robot files: how an MJCF or a URDF becomes a `Model` and a `Model` an MJCF; bundled scenes."""

from rbjax.loading.load import compile_model, load, scenes
from rbjax.loading.write_mjcf import write_mjcf

__all__ = ["compile_model", "load", "scenes", "write_mjcf"]
