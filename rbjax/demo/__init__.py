"""`rbjax demo`: the main job on bundled scenes, as pictures and a report."""

from rbjax.demo.run import demo

__all__ = ["demo"]
