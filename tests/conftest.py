"""Setup shared by all tests.

The tests are a caller of rbjax, so they choose x64 here; rbjax itself never touches `jax.config`.
JAX reads `JAX_COMPILATION_CACHE_DIR` by itself: the Makefile sets it, a bare `pytest` does without.
"""

import gc
import itertools
import os
import sys
import zlib
from collections.abc import Iterator
from pathlib import Path

import jax
import pytest
from jaxlib.version import __version_info__ as jaxlib_version

from tests import slow_list

jax.config.update("jax_enable_x64", True)

# Most of the time of the tests is XLA compiling programs that then run for milliseconds. Without
# the optimizations of XLA's own LLVM and without the fusion emitters a small program compiles in
# 0.4 of the time, a large one in 0.6. These flags do not reach rbjax's own machine code, which
# runs as it does for users. A test whose subject is XLA's optimized code passes
# `tests.robots.AS_USERS` to its `jit`. A run that includes the slow tests has no flags.
QUICK_FLAGS = ["--xla_backend_optimization_level=0"]
if jaxlib_version < (0, 11):  # jaxlib 0.11 has no choice of emitters and rejects unknown flags
    QUICK_FLAGS.append("--xla_cpu_use_fusion_emitters=false")
    # By default a program is split in 32 parts that compile in parallel: a tenth more work.
    QUICK_FLAGS.append("--xla_cpu_parallel_codegen_split_count=1")


def pytest_configure(config: pytest.Config) -> None:
    """Set XLA's flags, which XLA reads when it compiles the first program."""
    on_gpu = "cuda" in os.environ.get("JAX_PLATFORMS", "")
    if "not slow" in config.option.markexpr and not on_gpu:
        given = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = " ".join([*QUICK_FLAGS, given]).strip()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark the functions of `slow.txt` as slow, and as listed there."""
    names = slow_list.listed()
    for item in items:
        if slow_list.function(item.nodeid) in names:
            item.add_marker(pytest.mark.slow)
            item.add_marker(pytest.mark.listed)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Append the CPU time of a test and its child processes to a file, for `tests.slow_list`."""
    start = sum(os.times()[:4])
    try:
        return (yield)
    finally:
        if path := os.environ.get(slow_list.VARIABLE):
            with open(path, "a") as file:
                file.write(f"{sum(os.times()[:4]) - start:.3f} {item.nodeid}\n")


def pytest_collection_finish() -> None:
    """A benchmark's clock turns JAX's compilation cache off, for all tests of this process.

    Tracing makes objects by the million; Python's search for cycles among them, which begins at
    every 700 that stay, takes a tenth of a run."""
    if "benchmarks.shared.timing" in sys.modules:
        raise pytest.UsageError("a test imports benchmarks.shared.timing: no cache from then on")
    gc.collect()
    gc.freeze()
    gc.set_threshold(100_000, 20, 50)


# Every compiled program keeps some memory mapped, and Linux allows a process 65,530 maps; beyond
# that LLVM dies of "Cannot allocate memory". Linux takes 10 ms to list them.
MAPS, MANY_MAPS, EVERY = Path("/proc/self/maps"), 25_000, 10
PAGES, MANY_PAGES = Path("/proc/self/statm"), 2**19  # 2 GiB more than is there once all is let go
tests_so_far = itertools.count(1)
pages_that_stay = 0


@pytest.fixture
def key(request: pytest.FixtureRequest) -> jax.Array:
    """A random key for each test, the same on every run."""
    return jax.random.key(zlib.crc32(request.node.nodeid.encode()))


@pytest.fixture(autouse=True)
def _programs_are_let_go() -> Iterator[None]:
    global pages_that_stay
    yield
    if next(tests_so_far) % EVERY or not MAPS.exists():
        return
    many_maps = MAPS.read_bytes().count(b"\n") > MANY_MAPS
    if many_maps or _pages() > pages_that_stay + MANY_PAGES:
        jax.clear_caches()
        gc.collect()
        pages_that_stay = _pages()


def _pages() -> int:
    """This process's memory."""
    return int(PAGES.read_text().split()[1])
