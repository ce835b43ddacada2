"""Lowering rules for reductions, cumulative sums and sorting."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from rbjax._jax_compat import UNVMAP
from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.statements import BOOL, I32, Block, Value, While
from rbjax.compiler.lower import arrays
from rbjax.compiler.lower.arrays import ThreadArray, View
from rbjax.compiler.lower.delayed import Delayed
from rbjax.compiler.lower.elementwise import LOOP_ABOVE, map_entrywise, source
from rbjax.compiler.lower.linear import sum_terms
from rbjax.compiler.lower.lowering import Equation, Lowering, accepts_delayed, dtype_of, rule


def reduce_entries(
    low: Lowering, x: ThreadArray, axes: tuple, dtype: DTypeLike, f: Callable
) -> ThreadArray:
    """Reduce the entries of x along axes by f, a function of two values."""
    axes = tuple(axes)
    kept = [k for k in range(x.ndim) if k not in axes]
    shape = tuple(x.shape[k] for k in kept)
    count = int(np.prod([x.shape[k] for k in axes], dtype=int))
    if low.b.in_team and count and not isinstance(x, np.ndarray):
        delayed = _delayed(low, x, kept, list(axes), dtype, f)
        if delayed is not None:
            return delayed
    if x.size > LOOP_ABOVE and count:
        return _looped(low, arrays.to_memory(low.b, x, dtype), kept, list(axes), dtype, f)
    entries = low.to_scalars(x).transpose(*kept, *axes).reshape(*shape, count)
    out = np.empty(shape, object)
    for i in arrays.indices_of(shape):
        out[i] = functools.reduce(f, entries[i])
    return out


def _delayed(
    low: Lowering, x: ThreadArray, kept: list, axes: list, dtype: DTypeLike, f: Callable
) -> Delayed | None:
    """Return a reduction as a delayed array; None if the work is too small for a team.
    A reduction over all of several axes first reduces all axes except the longest."""
    s = source(low.b, x, x.shape)
    if s.work <= arrays.SHARED_ABOVE:
        return None
    if not kept:
        if len(axes) == 1:
            return None
        longest = max(axes, key=lambda k: x.shape[k])
        rest = [k for k in axes if k != longest]
        rows = _delayed(low, x, [longest], rest, dtype, f)
        assert rows is not None
        kept, axes, s = [], [0], source(low.b, arrays.to_memory(low.b, rows, dtype), rows.shape)
    shape, count = tuple(s.shape[k] for k in kept), tuple(s.shape[k] for k in axes)

    def entry(*i: Value) -> Value:
        def term(*k: Value) -> Value:
            at = dict(zip((*kept, *axes), (*i, *k), strict=True))
            return s.entry(*(at[j] for j in range(s.ndim)))

        return sum_terms(low.b, count, term, f, dtype)

    cost = int(np.prod(count, dtype=int)) * (1 + s.cost)
    return Delayed(shape, np.dtype(dtype), entry, s.sources, cost)


@rule("reduce")
def _reduce_by_function(low: Lowering, eqn: Equation, ins: list) -> list:
    body, axes = eqn.params["jaxpr"], eqn.params["dimensions"]
    n, shape = len(ins) // 2, eqn.outvars[0].aval.shape
    kept = [k for k in range(ins[0].ndim) if k not in axes]
    rows = [low.to_scalars(x).transpose(*kept, *axes).reshape(*shape, -1) for x in ins[:n]]
    outs = [np.empty(shape, object) for _ in range(n)]
    for i in arrays.indices_of(shape):
        totals = list(ins[n:])
        for k in range(rows[0].shape[-1]):
            totals = low.closed(
                body, [*totals, *(arrays.full_of((), row[(*i, k)]) for row in rows)]
            )
        for out, total in zip(outs, totals, strict=True):
            out[i] = low.to_scalar(total)
    return list(outs)


def _looped(low: Lowering, x: View, kept: list, axes: list, dtype: DTypeLike, f: Callable) -> View:
    b = low.b
    x = x.transposed([*kept, *axes])
    shape, rest = x.shape[: len(kept)], x.shape[len(kept) :]
    out = View.of(b.local(dtype, int(np.prod(shape, dtype=int))), shape)

    def one(*i: Value) -> None:
        zero = np.int32(0)
        first = arrays.load_entry(b, x, (*i, *(zero for _ in rest)))
        total, started = b.declare(dtype, first), b.declare(BOOL, np.bool_(False))

        def more(*k: Value) -> None:
            value = arrays.load_entry(b, x, (*i, *k))
            b.assign(total, b.select(started, f(total, value), value))
            b.assign(started, np.bool_(True))

        arrays.for_each_index(b, rest, more)
        arrays.store_entry(b, out, i, total)

    arrays.for_each_index(b, shape, one)
    return out


REDUCTIONS = {
    "reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min",
    "reduce_and": "and", "reduce_or": "or", "reduce_xor": "xor",
}  # fmt: skip


def _neutral(name: str, dtype: np.dtype) -> Any:
    """Return the neutral element of a reduction, such as 0 for "add"."""
    if name in ("add", "or", "xor"):
        return 0
    if name == "and":
        return np.invert(dtype.type(0))
    if name == "mul":
        return 1
    sign = -1 if name == "max" else 1
    if dtype.kind == "f":
        return sign * np.inf
    if dtype == BOOL:
        return name == "min"
    return np.iinfo(dtype).min if name == "max" else np.iinfo(dtype).max


def _reduce(low: Lowering, eqn: Equation, ins: list) -> list:
    name = REDUCTIONS[eqn.primitive.name]
    dtype, x = dtype_of(eqn.outvars[0].aval), ins[0]
    if not x.size:
        return [np.full(eqn.outvars[0].aval.shape, _neutral(name, dtype), dtype)]
    f = functools.partial(low.b.op, name, dtype)
    return [reduce_entries(low, x, eqn.params["axes"], dtype, f)]


rule(*REDUCTIONS)(_reduce)
accepts_delayed(*REDUCTIONS)


def _unvmap(low: Lowering, eqn: Equation, ins: list) -> list:
    """Lower a reduction over the batch to one over the entries of a sample: a thread has one
    sample."""
    x, dtype, name = ins[0], eqn.outvars[0].aval.dtype, UNVMAP[eqn.primitive.name]
    if not x.size:
        return [np.asarray(name == "and", dtype)]
    f = functools.partial(low.b.op, name, dtype)
    return [reduce_entries(low, x, tuple(range(x.ndim)), dtype, f)]


rule(*UNVMAP)(_unvmap)


@rule("argmax", "argmin")
def _arg(low: Lowering, eqn: Equation, ins: list) -> list:
    (axis,), dtype = eqn.params["axes"], dtype_of(eqn.outvars[0].aval)
    b, better = low.b, "gt" if eqn.primitive.name == "argmax" else "lt"

    def wins(value: Value, best: Value) -> Value:
        out = b.op(better, BOOL, value, best)
        if best.dtype.kind == "f":  # the first nan wins
            is_nan, was_not = b.op("ne", BOOL, value, value), b.op("eq", BOOL, best, best)
            out = b.op("or", BOOL, out, b.op("and", BOOL, is_nan, was_not))
        return out

    if ins[0].size > LOOP_ABOVE:
        view = arrays.to_memory(b, ins[0], eqn.invars[0].aval.dtype)

        def one(x: View, out: View, *i: Value) -> None:
            best = b.declare(x.dtype, arrays.load_entry(b, x, (*i, np.int32(0))))
            at = b.declare(dtype, dtype.type(0))
            with b.loop(x.shape[-1]) as k:
                value = arrays.load_entry(b, x, (*i, k))
                with b.when(wins(value, best)):
                    b.assign(best, value)
                    b.assign(at, b.cast(k, dtype))
            arrays.store_entry(b, out, i, at)

        return [_along(low, view, axis, dtype, one)]
    x = np.moveaxis(low.to_scalars(ins[0]), axis, -1)
    out = np.empty(x.shape[:-1], object)
    for i in arrays.indices_of(out.shape):
        best, at = x[i][0], dtype.type(0)
        for k, value in enumerate(x[i][1:], 1):
            won = wins(value, best)
            best, at = b.select(won, value, best), b.select(won, dtype.type(k), at)
        out[i] = at
    return [out]


CUMULATIVE = {"cumsum": "add", "cumprod": "mul", "cummax": "max", "cummin": "min"}


def _cumulative(low: Lowering, eqn: Equation, ins: list) -> list:
    name, axis = CUMULATIVE[eqn.primitive.name], eqn.params["axis"]
    dtype = dtype_of(eqn.outvars[0].aval)
    if ins[0].size > LOOP_ABOVE:
        return [_cumulative_looped(low, arrays.to_memory(low.b, ins[0], dtype), eqn, name)]
    x = np.moveaxis(low.to_scalars(ins[0]), axis, 0)
    x = x[::-1] if eqn.params["reverse"] else x
    out = x.copy()
    for k in range(1, len(x)):
        for i in arrays.indices_of(x.shape[1:]):
            out[(k, *i)] = low.b.op(name, dtype, out[(k - 1, *i)], x[(k, *i)])
    out = out[::-1] if eqn.params["reverse"] else out
    return [np.moveaxis(out, 0, axis)]


def _cumulative_looped(low: Lowering, x: View, eqn: Equation, name: str) -> View:
    b, axis, reverse = low.b, eqn.params["axis"], eqn.params["reverse"]
    out = View.of(b.local(x.dtype, x.size), x.shape)
    order = [*(k for k in range(x.ndim) if k != axis), axis]
    source, to = x.transposed(order), out.transposed(order)
    n = x.shape[axis]

    def one(*i: Value) -> None:
        first = (*i, np.int32(n - 1 if reverse else 0))
        total = b.declare(x.dtype, arrays.load_entry(b, source, first))
        arrays.store_entry(b, to, first, total)
        with b.loop(n - 1, reverse=reverse) as k:
            here = (*i, k if reverse else b.op("index_add", k.dtype, k, np.int32(1)))
            b.assign(total, b.op(name, x.dtype, total, arrays.load_entry(b, source, here)))
            arrays.store_entry(b, to, here, total)

    arrays.for_each_index(b, source.shape[:-1], one)
    return out


def _along(low: Lowering, x: View, axis: int, dtype: DTypeLike, f: Callable) -> View:
    """Reduce an axis of x by loops in memory, and return the results as a local array.

    f: function (x with `axis` last, result, *index) that emits the reduction at an index of the
        other axes.
    """
    rest = [k for k in range(x.ndim) if k != axis]
    moved = x.transposed([*rest, axis])
    shape = moved.shape[:-1]
    out = View.of(low.b.local(dtype, int(np.prod(shape, dtype=int))), shape)
    arrays.for_each_index(low.b, shape, lambda *i: f(moved, out, *i))
    return out


rule(*CUMULATIVE)(_cumulative)


#: the most entries of a row that is sorted in registers
REGISTERS = 16


def before(b: Builder, x: Sequence[Value], y: Sequence[Value]) -> Value:
    """Emit the condition that x precedes y in lexicographic order, in which nan is last."""
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
    """Sort several arrays together along an axis, stably, by the first `keys` arrays."""
    if xs[0].shape[axis] > REGISTERS or xs[0].size > LOOP_ABOVE:
        return _sort_in_memory(low, xs, dtypes, axis, keys)
    b = low.b
    outs = [np.moveaxis(low.to_scalars(x), axis, -1).copy() for x in xs]
    for i in arrays.indices_of(outs[0].shape[:-1]):
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
    """Emit an insertion sort in memory of several arrays, by the first `keys` arrays."""
    b = low.b
    outs = [arrays.copy_to_memory(b, x, dtype) for x, dtype in zip(xs, dtypes, strict=True)]
    shape = outs[0].shape
    rest = [k for k in range(len(shape)) if k != axis]

    def one(*index: Value) -> None:
        def at(k: Value) -> list[Value]:
            full: list[Value] = [I32.type(0)] * len(shape)
            for place, value in zip((*rest, axis), (*index, k), strict=True):
                full[place] = value
            return full

        with b.loop(shape[axis] - 1) as turn:
            held = [
                arrays.load_entry(b, out, at(b.op("add", I32, turn, I32.type(1)))) for out in outs
            ]
            gap = b.declare(I32, b.op("add", I32, turn, I32.type(1)))
            goes = b.declare(BOOL, np.bool_(True))
            node = While(Block(), goes, Block())
            b.block.statements.append(node)
            with b.inside(node.body):
                previous = b.op("sub", I32, gap, I32.type(1))
                there = [arrays.load_entry(b, out, at(previous)) for out in outs]
                later = before(b, held[:keys], there[:keys])
                for out, mine, other in zip(outs, held, there, strict=True):
                    arrays.store_entry(b, out, at(gap), b.select(later, other, mine))
                b.assign(goes, later)
                with b.when(b.op("and", BOOL, later, b.op("eq", BOOL, previous, I32.type(0)))):
                    for out, mine in zip(outs, held, strict=True):
                        arrays.store_entry(b, out, at(previous), mine)
                    b.assign(goes, np.bool_(False))
                b.assign(gap, previous)

    arrays.for_each_index(b, [shape[k] for k in rest], one)
    return [View(o.array, o.base, o.offset, o.strides, o.shape) for o in outs]


@rule("top_k")
def _top_k(low: Lowering, eqn: Equation, ins: list) -> list:
    """Find the k largest entries in descending order, and their indices. nan is first."""
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
    """Emit an integer that decreases as x increases in IEEE 754's total order."""
    if x.dtype.kind != "f":
        return b.op("not", x.dtype, x)
    kind = np.dtype(f"i{x.dtype.itemsize}")
    bits = b.op("bitcast", kind, x)
    negative = b.op("lt", BOOL, bits, kind.type(0))
    flipped = b.op("xor", kind, bits, kind.type(np.iinfo(kind).max))
    return b.op("not", kind, b.select(negative, flipped, bits))
