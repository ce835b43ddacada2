"""Lowering rules for slices at indices that may not be constant.

Constant indices need no operations. For other indices, the operand is put in memory, or a small
array stays in registers and selections choose the entry.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from numpy.typing import DTypeLike

from rbjax.compiler.ir.statements import BOOL, I32, Value, Var
from rbjax.compiler.lower import arrays
from rbjax.compiler.lower.arrays import ThreadArray, View
from rbjax.compiler.lower.lowering import Equation, Lowering, dtype_of, rule

#: arrays in registers with at most this many entries are indexed by selections
SELECT_UP_TO = 8


def clamp(low: Lowering, index: Value, most: int) -> Value:
    """Emit the clamp of an index to 0 ... most, as int32."""
    if not isinstance(index, Var):
        return I32.type(min(max(int(index), 0), most))
    if most <= 0:
        return I32.type(0)
    b, kind = low.b, index.dtype
    if kind.kind != "u":
        index = b.op("max", kind, index, kind.type(0))
    if most <= np.iinfo(kind).max:
        index = b.op("min", kind, index, kind.type(most))
    return b.cast(index, I32)


def is_in_bounds(low: Lowering, index: Value, most: int) -> Value:
    """Emit the condition 0 <= index <= most."""
    b, kind = low.b, index.dtype
    ok: Value = np.bool_(True)
    if kind.kind != "u":
        ok = b.op("ge", BOOL, index, kind.type(0))
    if most <= np.iinfo(kind).max:
        ok = b.op("and", BOOL, ok, b.op("le", BOOL, index, kind.type(most)))
    return ok


def make_updatable(low: Lowering, x: ThreadArray, dtype: DTypeLike) -> View:
    """Return x as memory that may be updated: x itself if it is updatable, else a copy."""
    if isinstance(x, View) and x.is_updatable:
        return x
    return arrays.copy_to_memory(low.b, x, dtype)


def _moved(low: Lowering, view: View, starts: Sequence[Value], sizes: Sequence[int]) -> View:
    box = [slice(0, n, 1) for n in sizes]
    return view.slice_box(box).shift(low.b, *zip(starts, view.strides, strict=True))


@rule("dynamic_slice")
def _dynamic_slice(low: Lowering, eqn: Equation, ins: list) -> list:
    x, sizes = ins[0], eqn.params["slice_sizes"]
    starts = [
        clamp(low, low.to_scalar(i), n - size)
        for i, n, size in zip(ins[1:], x.shape, sizes, strict=True)
    ]
    known = [s.item() for s in starts if not isinstance(s, Var)]
    if len(known) == len(starts):
        box = tuple(slice(s, s + n, 1) for s, n in zip(known, sizes, strict=True))
        return [x.slice_box(box) if isinstance(x, View) else x[box]]
    if not isinstance(x, View) and not arrays.is_constant(x) and x.size <= SELECT_UP_TO:
        return [_selected(low, x, starts, sizes)]
    view = _moved(low, arrays.to_memory(low.b, x, dtype_of(eqn.outvars[0].aval)), starts, sizes)
    if view.array.mutable and view.size <= SELECT_UP_TO:
        return [low.to_scalars(view)]  # loaded now, because the array may be updated in place later
    return [view]


def _selected(low: Lowering, x: np.ndarray, starts: list, sizes: Sequence[int]) -> np.ndarray:
    b = low.b
    for axis, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        pieces = [np.take(x, range(k, k + size), axis) for k in range(x.shape[axis] - size + 1)]
        out = pieces[-1]
        for k in reversed(range(len(pieces) - 1)):
            here = b.op("eq", BOOL, start, I32.type(k))
            out = arrays.as_objects(out).copy()
            for i in arrays.indices_of(out.shape):
                out[i] = b.select(here, pieces[k][i], out[i])
        x = out
    return x


@rule("dynamic_update_slice")
def _dynamic_update_slice(low: Lowering, eqn: Equation, ins: list) -> list:
    x, update, *index = ins
    dtype = dtype_of(eqn.outvars[0].aval)
    starts = [
        clamp(low, low.to_scalar(i), n - size)
        for i, n, size in zip(index, x.shape, update.shape, strict=True)
    ]
    known = [s.item() for s in starts if not isinstance(s, Var)]
    if not isinstance(x, View) and len(known) == len(starts):
        out = arrays.as_objects(x).copy()
        box = tuple(slice(s, s + n) for s, n in zip(known, update.shape, strict=True))
        out[box] = low.to_scalars(update)
        return [out]
    if not isinstance(x, View) and x.size <= SELECT_UP_TO:
        return [_updated(low, arrays.as_objects(x), low.to_scalars(update), starts)]
    with low.pinned([update]):
        whole = make_updatable(low, x, dtype)
    arrays.write_to(low.b, _moved(low, whole, starts, update.shape), update)
    return [whole]


def _updated(low: Lowering, x: np.ndarray, update: np.ndarray, starts: list) -> np.ndarray:
    b, out = low.b, x.copy()
    spans = [range(n - m + 1) for n, m in zip(x.shape, update.shape, strict=True)]
    for at in itertools.product(*spans):
        here: Value = np.bool_(True)
        for start, k in zip(starts, at, strict=True):
            here = b.op("and", BOOL, here, b.op("eq", BOOL, start, I32.type(k)))
        for i in arrays.indices_of(update.shape):
            to = tuple(np.add(at, i))
            out[to] = b.select(here, update[i], out[to])
    return out
