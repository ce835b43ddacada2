"""Robot files: how an MJCF or a URDF becomes a `Model`, and a `Model` an MJCF or the
numbers of the user's own file; bundled scenes."""

from rbjax.callable_modules import make_modules_callable
from rbjax.loading.load import compile_model, load, scenes
from rbjax.loading.write_back import write_back
from rbjax.loading.write_mjcf import write_mjcf

__all__ = ["compile_model", "load", "scenes", "write_back", "write_mjcf"]

make_modules_callable(__name__)
