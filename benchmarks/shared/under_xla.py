"""`under_xla`: for figures of XLA itself, because rbjax runs by LLVM on a CPU. This file is no
benchmark."""

import contextlib
import os
from collections.abc import Iterator
from unittest import mock

from rbjax.compiler.jax import backend


@contextlib.contextmanager
def under_xla() -> Iterator[None]:
    """Functions of rbjax that are traced and compiled here run under XLA."""
    with mock.patch.dict(os.environ, {backend.VARIABLE: "xla"}):
        backend.on_cpu.cache_clear()
        try:
            yield
        finally:
            backend.on_cpu.cache_clear()
