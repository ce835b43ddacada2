"""Local arrays of a thread in shared memory: which ones, their places, and results."""

from __future__ import annotations

import itertools
import re

import jax
import numpy as np
import pytest

from rbjax.compiler.cuda import driver, kernels, lockstep
from rbjax.compiler.cuda.kernels import kernel
from rbjax.compiler.cuda.shared_arrays import LEAST_ACCESSES, arrays_in_shared_memory
from rbjax.compiler.ir.statements import Reserve, walk
from tests.compiler.block import emulated
from tests.compiler.host import COMPILER, written
from tests.tolerances import F64_TRANSFORM, relative_error

RNG = np.random.default_rng(0)
TURNS = 40


def walkers(x, i):
    """Two arrays that a loop indexes, one of them more often, and one with constant indices."""

    def turn(k, c):
        often, seldom, plain = c
        often = often.at[(i + k) % 5].add(plain[0])
        often = often.at[(i + 2 * k) % 5].multiply(0.9)
        seldom = seldom.at[(i + k) % 40].set(often[k % 5])
        return often, seldom, plain.at[0].add(1e-3)

    often, seldom, plain = jax.lax.fori_loop(0, TURNS, turn, (x[:5], x, x[:2]))
    return often.sum() + (seldom**2).sum() + plain[0]


def sample(size):
    return RNG.normal(size=(size, 40)), RNG.integers(0, 40, size).astype(np.int32)


def local_sizes(program, places):
    arrays = [s.array for s in walk(program.builder.block) if isinstance(s, Reserve)]
    return sorted(a.size for a in arrays if a.id in places)


def test_arrays_with_most_accesses_come_first():
    program = written(walkers, *sample(64))[0]
    block = program.builder.block
    found = arrays_in_shared_memory(block, 32, 5 * 8 * 32)
    assert local_sizes(program, found.places) == [5] and found.bytes == 5 * 8 * 32
    assert arrays_in_shared_memory(block, 32, 5 * 8 * 32 - 1).places == {}
    # 40 entries with 120 accesses are left to the cache
    assert 3 * TURNS / 40 < LEAST_ACCESSES
    assert local_sizes(program, arrays_in_shared_memory(block, 32, 10**6).places) == [5]


def test_places_do_not_overlap(monkeypatch):
    monkeypatch.setattr("rbjax.compiler.cuda.shared_arrays.LEAST_ACCESSES", 0.0)
    block = written(walkers, *sample(64))[0].builder.block
    found, sizes = arrays_in_shared_memory(block, 256, 10**6), {}
    for s in walk(block):
        if isinstance(s, Reserve):
            sizes[s.array.id] = s.array.size * s.array.dtype.itemsize * 256
    starts = {
        key: 16 * int(re.search(r"dynamic\+(\d+)", x).group(1)) for key, x in found.places.items()
    }
    assert len(starts) >= 2
    ends = sorted((start, start + sizes[key]) for key, start in starts.items())
    assert all(a[1] <= b[0] for a, b in itertools.pairwise(ends))
    assert ends[-1][1] <= found.bytes


def test_short_programs_keep_their_arrays(monkeypatch):
    program = written(walkers, *sample(64))[0]
    code = kernel(program, multiprocessor_bytes=pytest.fail)  # on a GPU, a self-test
    assert code.shared_bytes == 0 and "dynamic" not in code.source
    monkeypatch.setattr(kernels, "FILLS_REGISTERS", 0)
    code = kernel(program)
    assert code.shared_bytes == 5 * 8 * 32 and "extern __shared__" in code.source
    assert kernel(program, multiprocessor_bytes=lambda: 0).shared_bytes == 0


@pytest.mark.parametrize("size", [65536, 64 * 132])
def test_all_blocks_of_a_multiprocessor_fit(monkeypatch, size):
    monkeypatch.setattr(kernels, "FILLS_REGISTERS", 0)
    monkeypatch.setattr("rbjax.compiler.cuda.shared_arrays.LEAST_ACCESSES", 0.0)
    program = written(walkers, *sample(size))[0]
    code, most = kernel(program), driver.shared_bytes_of("9.0")
    blocks = min(lockstep.MOST_WARPS * 32 // code.block, -(-code.grid // lockstep.MULTIPROCESSORS))
    assert 0 < blocks * (code.shared_bytes + kernels.DRIVERS_BYTES) <= most
    assert local_sizes(program, arrays_in_shared_memory(program.builder.block, 32, most).places)


def test_many_local_accesses_halve_the_warps(monkeypatch):
    """With half the warps in step, each of them has twice the shared memory."""
    program = written(walkers, *sample(65536))[0]
    both, each = program.builder.block, 45 * 8 * 32  # bytes of both arrays of a warp
    monkeypatch.setattr("rbjax.compiler.cuda.shared_arrays.LEAST_ACCESSES", 0.0)
    every, some, none = (arrays_in_shared_memory(both, 32, n) for n in (each, each - 1, 0))
    assert every.local == 0.0 < some.local < none.local
    monkeypatch.setattr(kernels, "FILLS_REGISTERS", 0)
    available = 4 * each + kernels.DRIVERS_BYTES
    assert kernel(program, multiprocessor_bytes=lambda: available).block == 32  # not in step
    for name in ("LONG_PROGRAM", "LONG_ITERATION", "LONG_LOOP", "LONG_WHILE"):
        monkeypatch.setattr(lockstep, name, 0)
    monkeypatch.setattr(kernels, "MOST_LOCAL", some.local / 2)
    code = kernel(program, multiprocessor_bytes=lambda: available)
    assert code.block == 4 * 32 and code.shared_bytes == 4 * each
    monkeypatch.setattr(kernels, "MOST_LOCAL", none.local)
    code = kernel(program, multiprocessor_bytes=lambda: available)
    assert code.block == 8 * 32 and 0 < code.shared_bytes < 8 * each


def test_shared_memory_of_devices():
    assert driver.shared_bytes_of("9.0") == 227 * 1024
    assert driver.shared_bytes_of("99.0") == driver.LEAST_KIB * 1024


@pytest.mark.skipif(COMPILER is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("least", [0.0, LEAST_ACCESSES])
def test_results(monkeypatch, least):
    monkeypatch.setattr(kernels, "FILLS_REGISTERS", 0)
    monkeypatch.setattr("rbjax.compiler.cuda.shared_arrays.LEAST_ACCESSES", least)
    x, i = sample(70)
    code = kernel(written(walkers, x, i)[0])
    assert code.shared_bytes
    want = np.asarray(jax.vmap(walkers)(x, i))
    (got,) = emulated(code, [x, i], [jax.ShapeDtypeStruct(want.shape, want.dtype)])
    assert relative_error(got, want) <= F64_TRANSFORM
