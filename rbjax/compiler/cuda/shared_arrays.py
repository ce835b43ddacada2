"""Chooses the local arrays of a thread that are in shared memory.

The local arrays of all threads of a multiprocessor do not fit into its L1 cache, and in a loop
their traffic to the L2 cache bounds the rate. So the arrays with the most accesses for each byte
are in shared memory. Entry k of an array is at `array[k * THREADS]`, which the threads of a warp
read without bank conflicts. Two kinds of arrays stay local: arrays whose indices are all constants,
which the compiler keeps in registers, and arrays with few accesses, because the rows of operands
and results use shared memory too (`kernels`).

`python -m benchmarks.gpu.contact` measures rollouts with contacts.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field

from rbjax.compiler.ir import statements as ir
from rbjax.compiler.ir.c_text import c_type

#: assumed iterations of a `while` loop, and of a `while` loop in its body
ITERATIONS, INNER_ITERATIONS = 6.0, 2.0
#: the fewest accesses of an entry of an array in shared memory
LEAST_ACCESSES = 16.0
#: each array starts at a multiple of this number of bytes
ALIGN = 16


@dataclass(frozen=True)
class SharedArrays:
    """Arrays in dynamic shared memory.

    places: id of an array -> C expression of the pointer to the first entry of a thread.
    bytes: size of all arrays of a block, in bytes.
    """

    places: dict[int, str]
    bytes: int


@dataclass
class _Uses:
    """The uses of the local arrays of a program.

    arrays: the arrays, by their ids.
    accesses: the loads and stores of each array, estimated.
    indexed: the ids of the arrays with an index that is a variable.
    """

    arrays: dict[int, ir.Array] = field(default_factory=dict)
    accesses: defaultdict[int, float] = field(default_factory=lambda: defaultdict(float))
    indexed: set[int] = field(default_factory=set)


def arrays_in_shared_memory(block: ir.Block, threads: int, available: int) -> SharedArrays:
    """Choose the arrays of a program that are in shared memory.

    threads: the threads of a block. available: bytes of shared memory for a block.
    """
    uses, places, end = _Uses(), dict[int, str](), 0
    _count(block, uses, 1.0, ITERATIONS)

    density = {  # accesses per byte
        key: uses.accesses[key] / a.size / a.dtype.itemsize
        for key, a in uses.arrays.items()
        if key in uses.indexed and uses.accesses[key] >= LEAST_ACCESSES * a.size
    }
    for key in sorted(density, key=lambda key: -density[key]):
        a = uses.arrays[key]
        bytes = -(-a.size * a.dtype.itemsize * threads // ALIGN) * ALIGN
        if end + bytes <= available:
            places[key] = f"({c_type(a.dtype)}*)(dynamic+{end // ALIGN})+threadIdx.x"
            end += bytes
    return SharedArrays(places, end)


def _count(block: ir.Block, uses: _Uses, times: float, iterations: float) -> None:
    """Add the uses of arrays in a block.

    times: how often the block runs. iterations: assumed iterations of a `while` loop in it.
    """
    for s in block.statements:
        match s:
            case ir.Reserve(array=array) if array.size:
                uses.arrays[array.id] = array
            case ir.Load(array=array, base=base) | ir.Store(array=array, base=base):
                uses.accesses[array.id] += times
                if isinstance(base, ir.Var):
                    uses.indexed.add(array.id)
            case ir.Loop(count=count, body=body):
                _count(body, uses, times * count, iterations)
            case ir.While():
                for inner in s.children():
                    _count(inner, uses, times * iterations, INNER_ITERATIONS)
            case _:
                for inner in s.children():
                    _count(inner, uses, times, iterations)
