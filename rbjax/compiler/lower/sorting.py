"""Rules for sorting: few entries in registers by swaps of neighbours, many in memory."""

from __future__ import annotations

import functools
from collections.abc import Sequence

import numpy as np

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.statements import BOOL, I32, Block, Value, While
from rbjax.compiler.lower.arrays import (
    View,
    copy_to_memory,
    for_each_index,
    indices_of,
    load_entry,
    store_entry,
)
from rbjax.compiler.lower.elementwise import LOOP_ABOVE, map_entrywise
from rbjax.compiler.lower.lowering import Equation, Lowering, dtype_of, rule

#: the most entries that are sorted in registers
REGISTERS = 16


def before(b: Builder, x: Sequence[Value], y: Sequence[Value]) -> Value:
    """Write whether x precedes y: by the first entry that differs; nan is last."""
    out: Value = np.bool_(False)
    for p, q in reversed(list(zip(x, y, strict=True))):
        less, same = b.op("lt", BOOL, p, q), b.op("eq", BOOL, p, q)
        if p.dtype.kind == "f":
            p_nan, q_nan = (b.op("ne", BOOL, v, v) for v in (p, q))
            less = b.op("or", BOOL, less, b.op("and", BOOL, q_nan, b.op("not", BOOL, p_nan)))
            same = b.op("or", BOOL, same, b.op("and", BOOL, p_nan, q_nan))
        out = b.op("or", BOOL, less, b.op("and", BOOL, same, out))
    return out


@rule("sort")
def _sort(low: Lowering, eqn: Equation, ins: list) -> list:
    dtypes = [dtype_of(v.aval) for v in eqn.outvars]
    return sort(low, ins, dtypes, eqn.params["dimension"], eqn.params["num_keys"])


def sort(low: Lowering, xs: list, dtypes: list, axis: int, keys: int) -> list[np.ndarray | View]:
    """Sort arrays by the first `keys` of them; the sort is stable."""
    if xs[0].shape[axis] > REGISTERS or xs[0].size > LOOP_ABOVE:
        return _sort_in_memory(low, xs, dtypes, axis, keys)
    b = low.b
    outs = [np.moveaxis(low.to_scalars(x), axis, -1).copy() for x in xs]
    for i in indices_of(outs[0].shape[:-1]):
        rows = [out[i] for out in outs]
        for k in range(1, len(rows[0])):
            for j in reversed(range(k)):
                lower, upper = [row[j] for row in rows], [row[j + 1] for row in rows]
                swap = before(b, upper[:keys], lower[:keys])
                for row, p, q in zip(rows, lower, upper, strict=True):
                    row[j], row[j + 1] = b.select(swap, q, p), b.select(swap, p, q)
    return [np.moveaxis(out, -1, axis) for out in outs]


def _sort_in_memory(
    low: Lowering, xs: list, dtypes: list, axis: int, keys: int
) -> list[np.ndarray | View]:
    """Write an insertion sort: each entry moves down until its predecessor is not later."""
    b = low.b
    outs = [copy_to_memory(b, x, dtype) for x, dtype in zip(xs, dtypes, strict=True)]
    shape = outs[0].shape
    rest = [k for k in range(len(shape)) if k != axis]

    def one(*index: Value) -> None:
        def at(k: Value) -> list[Value]:
            full: list[Value] = [I32.type(0)] * len(shape)
            for place, value in zip((*rest, axis), (*index, k), strict=True):
                full[place] = value
            return full

        with b.loop(shape[axis] - 1) as turn:
            held = [load_entry(b, out, at(b.op("add", I32, turn, I32.type(1)))) for out in outs]
            gap = b.declare(I32, b.op("add", I32, turn, I32.type(1)))
            goes = b.declare(BOOL, np.bool_(True))
            node = While(Block(), goes, Block())
            b.block.statements.append(node)
            with b.inside(node.body):
                previous = b.op("sub", I32, gap, I32.type(1))
                there = [load_entry(b, out, at(previous)) for out in outs]
                later = before(b, held[:keys], there[:keys])
                for out, mine, other in zip(outs, held, there, strict=True):
                    store_entry(b, out, at(gap), b.select(later, other, mine))
                b.assign(goes, later)
                with b.when(b.op("and", BOOL, later, b.op("eq", BOOL, previous, I32.type(0)))):
                    for out, mine in zip(outs, held, strict=True):
                        store_entry(b, out, at(previous), mine)
                    b.assign(goes, np.bool_(False))
                b.assign(gap, previous)

    for_each_index(b, [shape[k] for k in rest], one)
    return [View(o.array, o.base, o.offset, o.strides, o.shape) for o in outs]


@rule("top_k")
def _top_k(low: Lowering, eqn: Equation, ins: list) -> list:
    """Find the largest entries, in descending order: stable, with nan first."""
    x = ins[0]
    axis = eqn.params.get("axis", -1) % x.ndim
    kind, places = eqn.invars[0].aval.dtype, dtype_of(eqn.outvars[1].aval)
    key = np.dtype(f"i{kind.itemsize}") if kind.kind == "f" else kind
    rank = map_entrywise(low, key, x.shape, functools.partial(_descending, low.b), x)
    row = np.arange(x.shape[axis], dtype=places)
    row = np.broadcast_to(row.reshape([-1 if k == axis else 1 for k in range(x.ndim)]), x.shape)
    _, values, index = sort(low, [rank, x, row], [key, kind, places], axis, 1)
    best = [slice(0, n, 1) for n in x.shape]
    best[axis] = slice(0, eqn.params["k"], 1)
    return [y.slice_box(best) if isinstance(y, View) else y[tuple(best)] for y in (values, index)]


@rule("eq_to", "le_to", "lt_to")
def _total_order(low: Lowering, eqn: Equation, ins: list) -> list:
    """Compare in IEEE 754's total order, in which -0 < 0 and nan is the largest."""
    name = eqn.primitive.name.removesuffix("_to")
    turned = {"lt": "gt", "le": "ge"}.get(name, name)  # the ranks descend

    def compared(x: Value, y: Value) -> Value:
        return low.b.op(turned, BOOL, _descending(low.b, x), _descending(low.b, y))

    return [map_entrywise(low, BOOL, eqn.outvars[0].aval.shape, compared, *ins)]


def _descending(b: Builder, x: Value) -> Value:
    """Write an integer that decreases as x increases, in IEEE 754's total order."""
    if x.dtype.kind != "f":
        return b.op("not", x.dtype, x)
    kind = np.dtype(f"i{x.dtype.itemsize}")
    bits = b.op("bitcast", kind, x)
    negative = b.op("lt", BOOL, bits, kind.type(0))
    flipped = b.op("xor", kind, bits, kind.type(np.iinfo(kind).max))
    return b.op("not", kind, b.select(negative, flipped, bits))
