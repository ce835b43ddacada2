"""What every test shares.

The tests are a caller of rbjax, so they choose x64 here; rbjax itself never touches `jax.config`.
JAX reads `JAX_COMPILATION_CACHE_DIR` by itself: the Makefile sets it, a bare `pytest` does without.
"""

import zlib

import jax
import pytest

jax.config.update("jax_enable_x64", True)


@pytest.fixture
def key(request: pytest.FixtureRequest) -> jax.Array:
    """A random key of the test's own: the same on every run, another for every test."""
    return jax.random.key(zlib.crc32(request.node.nodeid.encode()))
