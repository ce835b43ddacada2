"""Chooses the local arrays of a thread that are in shared memory.

The local arrays of all threads of a multiprocessor do not fit into its L1 cache, and in a loop
their traffic to the L2 cache bounds the rate. So the arrays with the most accesses for each byte
are in shared memory. Entry k of an array is at `array[k * THREADS]`, which the threads of a warp
read without bank conflicts. Two kinds of arrays stay local: arrays whose indices are all constants,
which the compiler keeps in registers, and arrays with few accesses, because the rows of operands
and results use shared memory too (`kernels`).

What stays local is in the L2 cache, or beyond it in memory. So a program with many accesses to it
runs with fewer warps, each of which has more of the shared memory.

`python -m benchmarks.gpu.contact` measures rollouts with contacts.
"""

from __future__ import annotations

from dataclasses import dataclass

from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.c_text import c_type
from rbjax.compiler.passes.analysis import count_accesses, count_operations

#: assumed iterations of a `while` loop, and of a `while` loop in its body
ITERATIONS = 6, 2
#: the fewest accesses of an entry of an array in shared memory
LEAST_ACCESSES = 16.0
#: the most accesses of local arrays for each operation with which a multiprocessor has all its
#: warps. Humanoid with all geoms: 0.17, 50 M steps/s with 8 warps and 60 with 4; G1: 0.11, 32 and
#: 30; two feet: 0.05, 134 and 95
MOST_LOCAL = 0.14
#: each array starts at a multiple of this number of bytes
ALIGN = 16


@dataclass(frozen=True)
class SharedArrays:
    """Arrays in dynamic shared memory.

    places: id of an array -> C expression of the pointer to the first entry of a thread.
    bytes: size of all arrays of a block, in bytes.
    local: accesses of the other arrays with indices that are not constant, for each operation.
    """

    places: dict[int, str]
    bytes: int
    local: float


def arrays_in_shared_memory(block: ir.Block, threads: int, available: int) -> SharedArrays:
    """Choose the arrays of a program that are in shared memory.

    threads: the threads of a block. available: bytes of shared memory for a block.
    """
    statements, accesses = list(ir.walk(block)), count_accesses(block, ITERATIONS)
    arrays = {s.array.id: s.array for s in statements if isinstance(s, ir.Reserve)}
    indexed = {
        s.array.id
        for s in statements
        if isinstance(s, ir.Load | ir.Store) and isinstance(s.base, ir.Var)
    }
    density = {  # accesses per byte
        key: accesses[key] / a.size / a.dtype.itemsize
        for key, a in arrays.items()
        if key in indexed and accesses[key] >= LEAST_ACCESSES * a.size
    }
    places, end = dict[int, str](), 0
    for key in sorted(density, key=lambda key: -density[key]):
        a = arrays[key]
        bytes = -(-a.size * a.dtype.itemsize * threads // ALIGN) * ALIGN
        if end + bytes <= available:
            places[key] = f"({c_type(a.dtype)}*)(dynamic+{end // ALIGN})+threadIdx.x"
            end += bytes
    left = sum(accesses[key] for key in indexed - places.keys() if key in arrays)
    return SharedArrays(places, end, left / max(count_operations(block, ITERATIONS), 1))
