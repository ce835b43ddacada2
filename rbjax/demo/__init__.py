"""`rbjax demo`: rbjax on bundled scenes, with pictures and a report."""

from rbjax.demo.run import demo

__all__ = ["demo"]
