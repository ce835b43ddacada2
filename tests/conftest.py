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

# Nearly all that the tests take is XLA compiling programs that then run for milliseconds. Without
# LLVM's optimizations and without the fusion emitters a small program compiles in 0.4 of the time
# (23 ms for 55 ms), a large one in 0.6. A test of what users get, with the optimizations, gives
# `tests.robots.AS_USERS` to its `jit`; and a run with the slow tests is as users are throughout.
QUICK_FLAGS = ["--xla_backend_optimization_level=0"]
if jaxlib_version < (0, 11):  # which has no emitters to leave out, and dies of flags unknown to it
    QUICK_FLAGS.append("--xla_cpu_use_fusion_emitters=false")
    # A program is else cut in 32 parts, to be compiled beside each other: a tenth more work.
    QUICK_FLAGS.append("--xla_cpu_parallel_codegen_split_count=1")


def pytest_configure(config: pytest.Config) -> None:
    """Sets XLA's flags, which it reads later, when the first program is compiled."""
    on_gpu = "cuda" in os.environ.get("JAX_PLATFORMS", "")
    if "not slow" in config.option.markexpr and not on_gpu:
        given = os.environ.get("XLA_FLAGS", "")
        os.environ["XLA_FLAGS"] = " ".join([*QUICK_FLAGS, given]).strip()
        from rbjax.threads import backend
        from tests import quickly  # now that the flags are set: its imports compile something

        # With these flags XLA compiles a small program before LLVM does. `tests/threads` tests
        # LLVM's; notebooks and the command line, which are processes, and slow tests run as users.
        backend.usual = "xla"
        quickly.begin()
        config.pluginmanager.register(ByMachineCode())


#: large programs, of which JAX's part takes longer than LLVM's: half to two thirds of XLA's time
BY_MACHINE_CODE = {"sysid", "test_demo.py", "test_rollout.py", "test_march.py", "test_curves.py",
                   "test_linearly_implicit.py", "control"}  # fmt: skip


class ByMachineCode:
    """Some quick tests run as they do for users."""

    @pytest.fixture(autouse=True)
    def _by_machine_code(self, request: pytest.FixtureRequest) -> Iterator[None]:
        from rbjax.threads import backend

        wanted = "xla" if BY_MACHINE_CODE.isdisjoint(request.node.path.parts) else "llvm"
        if backend.usual != wanted:
            backend.usual = wanted
            backend.on_cpu.cache_clear()
        yield


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks as slow what a measured run found to be so."""
    names = slow_list.listed()
    for item in items:
        if item.nodeid in names:
            item.add_marker(pytest.mark.slow)


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
# that LLVM dies of "Cannot allocate memory". Linux takes 10 ms to list them. Recorded programs keep
# memory, too.
MAPS, MANY_MAPS, EVERY = Path("/proc/self/maps"), 25_000, 10
PAGES, MANY_PAGES = Path("/proc/self/statm"), 2**19  # 2 GiB more than is there once all is let go
tests_so_far = itertools.count(1)
pages_that_stay = 0


@pytest.fixture
def key(request: pytest.FixtureRequest) -> jax.Array:
    """A random key for each test, the same on every run."""
    return jax.random.key(zlib.crc32(request.node.nodeid.encode()))


@pytest.fixture
def by_xla(monkeypatch: pytest.MonkeyPatch) -> None:
    """For a test of what compilation does: nothing is evaluated by numpy."""
    monkeypatch.setattr("tests.quickly.by_xla", True)


@pytest.fixture(autouse=True)
def _programs_are_let_go() -> Iterator[None]:
    global pages_that_stay
    yield
    if next(tests_so_far) % EVERY or not MAPS.exists():
        return
    many_maps = MAPS.read_bytes().count(b"\n") > MANY_MAPS
    if many_maps or _pages() > pages_that_stay + MANY_PAGES:
        from tests import quickly

        quickly.let_go()
        jax.clear_caches()
        gc.collect()
        pages_that_stay = _pages()


def _pages() -> int:
    """This process's memory."""
    return int(PAGES.read_text().split()[1])
