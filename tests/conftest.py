"""What every test shares.

The tests are a caller of rbjax, so they choose x64 here; rbjax itself never touches `jax.config`.
JAX reads `JAX_COMPILATION_CACHE_DIR` by itself: the Makefile sets it, a bare `pytest` does without.
"""

import zlib
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest

jax.config.update("jax_enable_x64", True)

# Every compiled program keeps some memory mapped, and Linux allows a process 65,530 maps; beyond
# that LLVM dies of "Cannot allocate memory".
MAPS, MANY_MAPS = Path("/proc/self/maps"), 25_000


@pytest.fixture
def key(request: pytest.FixtureRequest) -> jax.Array:
    """A random key of the test's own: the same on every run, another for every test."""
    return jax.random.key(zlib.crc32(request.node.nodeid.encode()))


@pytest.fixture(autouse=True)
def _programs_are_let_go() -> Iterator[None]:
    yield
    if MAPS.exists() and MAPS.read_bytes().count(b"\n") > MANY_MAPS:
        jax.clear_caches()
