"""Robot files: how an MJCF or a URDF becomes a `Model`, and the bundled scenes."""

from rbjax.loading.load import compile_model, load, scenes

__all__ = ["compile_model", "load", "scenes"]
