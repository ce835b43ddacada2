"""The function around the statements of one sample, and the layout of samples in memory.

A batch has one or several axes, anywhere among those of an operand. A thread's pointer is moved to
its sample, and entries are read in place. On a GPU, the block fetches short rows of a batch-first
array together through shared memory, so that a warp reads whole lines.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jax.extend.core import ClosedJaxpr

from rbjax.compiler.cuda.c_source import PREAMBLE, Printer, c_type, table
from rbjax.compiler.ir.program import I32, I64, Array, Builder, Op, Reserve, walk
from rbjax.compiler.lower import (  # noqa: F401 (rules)
    control,
    effects,
    elementwise,
    factorise,
    gather,
    indexing,
    inversion,
    linear,
    random,
    reductions,
    sorting,
    special,
    spectral,
    structure,
)
from rbjax.compiler.lower.arrays import View, row_major
from rbjax.compiler.lower.lowering import DTYPES, Lowering, Unsupported
from rbjax.compiler.passes.phases import synchronised
from rbjax.compiler.passes.prune import prune
from rbjax.compiler.passes.reuse import share_memory


@dataclass(frozen=True)
class Layout:
    """The layout of the samples in an array.

    shape: of the array in memory. axes: for each axis of the batch, its place in that shape, or
    None if the array lacks it.
    """

    shape: tuple[int, ...]
    axes: tuple[int | None, ...]

    @property
    def sample(self) -> tuple[int, ...]:
        """The shape of one sample."""
        return tuple(n for k, n in enumerate(self.shape) if k not in self.axes)

    @property
    def strides(self) -> tuple[int, ...]:
        """The strides between entries of a sample."""
        every = row_major(self.shape)
        return tuple(s for k, s in enumerate(every) if k not in self.axes)

    @property
    def steps(self) -> tuple[int, ...]:
        """The strides between samples along each axis of the batch; 0 without this axis."""
        every = row_major(self.shape)
        return tuple(0 if axis is None else every[axis] for axis in self.axes)

    def rows(self, batch: tuple[int, ...]) -> int | None:
        """The entries of a sample, if samples are consecutive rows; else None."""
        if not self.axes or None in self.axes:
            return None
        n = math.prod(self.sample)
        steps, size = [], n
        for count in reversed(batch):
            steps.append(size)
            size *= count
        wanted = tuple(reversed(steps))
        alike = all(a == b or c == 1 for a, b, c in zip(self.steps, wanted, batch, strict=True))
        return n if alike and self.strides == row_major(self.sample) else None


def batch_first(sample: Sequence[int], batch: Sequence[int]) -> Layout:
    """A result with the axes of the batch before its own."""
    return Layout((*batch, *sample), tuple(range(len(batch))))


def batch_last(sample: Sequence[int], batch: Sequence[int]) -> Layout:
    """A result with the axes of the batch after its own."""
    n = len(sample)
    return Layout((*sample, *batch), tuple(range(n, n + len(batch))))


@dataclass(frozen=True)
class Written:
    """A program with its operands, results and batch."""

    builder: Builder
    operands: tuple[Array, ...]
    results: tuple[Array, ...]
    layouts: tuple[tuple[Layout, ...], tuple[Layout, ...]]
    batch: tuple[int, ...]
    summed: tuple[bool, ...]

    @property
    def statements(self) -> int:
        """Operations in one thread's code; those of a loop count once."""
        return sum(isinstance(s, Op) for s in walk(self.builder.block))

    @property
    def array_bytes(self) -> int:
        """Bytes of the local arrays of one thread."""
        arrays = [s.array for s in walk(self.builder.block) if isinstance(s, Reserve)]
        return sum(a.size * a.dtype.itemsize for a in arrays)


def write_program(
    closed: ClosedJaxpr,
    batch: tuple[int, ...],
    operands: Sequence[Layout],
    results: Sequence[Layout],
    summed: Sequence[bool] = (),
    platform: str = "cuda",
    team: bool = False,
    matrices: bool = False,
) -> Written:
    """The program of one sample of a batch. Summed results are sums over the batch. team: for a
    team of threads a sample (`team.kernel`). matrices: those of one sample fill a CPU's vectors."""
    b = Builder(platform, team, matrices)
    ins = [_array(b, v.aval.dtype, lay, "operand") for v, lay in zip(
        closed.jaxpr.invars, operands, strict=True)]  # fmt: skip
    summed = tuple(summed) or (False,) * len(results)
    outs = [_array(b, v.aval.dtype, lay, "result") for v, lay in zip(
        closed.jaxpr.outvars, results, strict=True)]  # fmt: skip
    places = [
        View(a, None, 0, lay.strides, lay.sample) for a, lay in zip(outs, results, strict=True)
    ]
    args = [
        View(a, None, 0, lay.strides, lay.sample) for a, lay in zip(ins, operands, strict=True)
    ]
    with Lowering(b).held(args):
        Lowering(b).closed(closed, args, places)
    prune(b.block)
    if team:
        b.block = synchronised(b.block)
    share_memory(b.block)
    layouts = tuple(operands), tuple(results)
    return Written(b, tuple(ins), tuple(outs), layouts, batch, summed)


def _array(b: Builder, dtype: Any, layout: Layout, space: str) -> Array:
    if dtype not in DTYPES:
        raise Unsupported(f"{space} of type {dtype}")
    reach = sum((n - 1) * s for n, s in zip(layout.sample, layout.strides, strict=True)) + 1
    index = I64 if reach > np.iinfo(np.int32).max else I32
    return b.outside(dtype, math.prod(layout.sample), space, index)


def parameters(program: Written, restrict: str) -> str:
    """The pointers that a function of the program takes: operands, then results."""
    reads = [
        f"const {c_type(a.dtype)}* {restrict} p{k}" for k, a in enumerate(program.operands)
    ]
    writes = [f"{c_type(a.dtype)}* {restrict} r{k}" for k, a in enumerate(program.results)]
    return ", ".join(reads + writes)


def sample_index(batch: tuple[int, ...]) -> list[str]:
    """The index along each axis of the batch, from the linear index b."""
    out, rest = [], "b"
    for k in reversed(range(len(batch))):
        if k == 0:
            out.append(rest)
        else:
            out.append(f"({rest}%{batch[k]})")
            rest = f"({rest}/{batch[k]})"
    return list(reversed(out))


def offset(layout: Layout, index: list[str]) -> str:
    """The offset of a sample, as C."""
    terms = [f"{i}*{step}ll" for i, step in zip(index, layout.steps, strict=True) if step]
    return "+".join(terms) or "0"


HOST_HEAD = """
#include <cmath>
#include <math.h>
#define QUALIFIED static inline
#define RSQRTf(x) (1.0f/sqrtf(x))
#define RSQRT(x) (1.0/sqrt(x))
typedef float c_float;
typedef double c_double;
using std::isfinite;
"""


def host_source(program: Written, name: str = "run") -> str:
    """A C++ function over the whole batch, for a host's compiler: name(pointers)."""
    ops, outs = program.layouts
    index = sample_index(program.batch)
    names, body = {}, []
    for k, (array, layout) in enumerate(zip(program.operands, ops, strict=True)):
        names[array.id] = f"x{k}"
        body.append(f"const {c_type(array.dtype)}* x{k}=p{k}+({offset(layout, index)});")
    after = []
    for k, (array, layout) in enumerate(zip(program.results, outs, strict=True)):
        names[array.id] = f"y{k}"
        if program.summed[k]:
            n = max(array.size, 1)
            body.append(f"{c_type(array.dtype)} y{k}[{n}];")
            after.append(f"for(int i=0;i<{array.size};i++)r{k}[i]+=y{k}[i];")
        else:
            body.append(f"{c_type(array.dtype)}* y{k}=r{k}+({offset(layout, index)});")
    lines = Printer(names).lines(program.builder.block)
    tables = [table(a, "static const") for a in program.builder.tables]
    clear = [
        f"for(int i=0;i<{a.size};i++)r{k}[i]=0;"
        for k, a in enumerate(program.results) if program.summed[k]
    ]  # fmt: skip
    head = f'extern "C" void {name}({parameters(program, "")}){{'
    loop = f"for(long long b=0;b<{math.prod(program.batch)}ll;b++){{"
    parts = [HOST_HEAD, PREAMBLE, *tables, head, *clear, loop, *body, *lines, *after, "}}"]
    return "\n".join(parts)
