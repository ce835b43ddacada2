"""`under_xla`: for figures of XLA itself, because rbjax runs by LLVM on a CPU. This file is no
benchmark."""

import contextlib
import os
from collections.abc import Iterator
from unittest import mock

from rbjax.compiler.jax import launch


@contextlib.contextmanager
def under_xla() -> Iterator[None]:
    """Functions of rbjax that are traced and compiled here run under XLA."""
    with mock.patch.dict(os.environ, {launch.VARIABLE: "xla"}):
        launch.uses_llvm.cache_clear()
        try:
            yield
        finally:
            launch.uses_llvm.cache_clear()
