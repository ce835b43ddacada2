"""Lowers the jaxpr of one sample to its finished program, by lowering rules and then passes."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jax.extend.core import ClosedJaxpr
from numpy.typing import DTypeLike

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.program import BatchLayout, Written
from rbjax.compiler.ir.statements import I32, I64, Array, Unsupported
from rbjax.compiler.lower import (  # noqa: F401 (rules)
    control,
    elementwise,
    factorise,
    gather,
    indexing,
    linear,
    random,
    reductions,
    special,
    spectral,
    structure,
)
from rbjax.compiler.lower.arrays import View
from rbjax.compiler.lower.lowering import DTYPES, Lowering
from rbjax.compiler.passes.liveness import prune, share_memory
from rbjax.compiler.passes.phases import insert_barriers


def write_program(
    closed: ClosedJaxpr,
    batch: tuple[int, ...],
    operands: Sequence[BatchLayout],
    results: Sequence[BatchLayout],
    summed: Sequence[bool] = (),
    platform: str = "cuda",
    team: bool = False,
    matrices: bool = False,
) -> Written:
    """Lower the jaxpr of one sample of a batch to a finished program.

    Args:
        closed: the jaxpr of one sample.
        batch: sizes of the axes of the batch.
        operands, results: memory layouts of the arrays.
        summed: for each result, whether it is the sum over the batch.
        platform: "cuda" or "cpu".
        team: whether a block of GPU threads runs one sample together (`team.kernel`).
        matrices: whether the loops over a sample's matrices use the vectors of a CPU.
    """
    b = Builder(platform, team, matrices)
    ins = [_array(b, v.aval.dtype, lay, "operand") for v, lay in zip(
        closed.jaxpr.invars, operands, strict=True)]  # fmt: skip
    summed = tuple(summed) or (False,) * len(results)
    outs = [_array(b, v.aval.dtype, lay, "result") for v, lay in zip(
        closed.jaxpr.outvars, results, strict=True)]  # fmt: skip
    places = [
        View(a, None, 0, lay.strides, lay.sample) for a, lay in zip(outs, results, strict=True)
    ]
    args = [View(a, None, 0, lay.strides, lay.sample) for a, lay in zip(ins, operands, strict=True)]
    with Lowering(b).pinned(args):
        Lowering(b).closed(closed, args, places)
    prune(b.block)
    if team:
        b.block = insert_barriers(b.block)
    share_memory(b.block)
    layouts = tuple(operands), tuple(results)
    return Written(b, tuple(ins), tuple(outs), layouts, batch, summed)


def _array(b: Builder, dtype: DTypeLike, layout: BatchLayout, space: str) -> Array:
    if dtype not in DTYPES:
        raise Unsupported(f"{space} of type {dtype}")
    reach = sum((n - 1) * s for n, s in zip(layout.sample, layout.strides, strict=True)) + 1
    index = I64 if reach > np.iinfo(np.int32).max else I32
    return b.external_array(dtype, math.prod(layout.sample), space, index)
