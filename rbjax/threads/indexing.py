"""Rules of primitives that index: slices at an index that is not known, gather, scatter.

Where indices are known nothing is computed. Otherwise the operand lies in memory; an array of few
entries stays in registers, and selections find the entry.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode

from rbjax.threads.arrays import Small, View, in_memory, is_known, objects, owned_copy, tidy, write
from rbjax.threads.lowering import Lowering, Unsupported, dtype_of, rule
from rbjax.threads.program import BOOL, I32, Value, Var

#: an array in registers of at most so many entries is indexed by selections
SELECT_UP_TO = 8


def clamped(low: Lowering, index: Value, most: int) -> Value:
    """The index moved into 0 ... most."""
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


def in_bounds(low: Lowering, index: Value, most: int) -> Value:
    """Whether 0 <= index <= most."""
    b, kind = low.b, index.dtype
    ok: Value = np.bool_(True)
    if kind.kind != "u":
        ok = b.op("ge", BOOL, index, kind.type(0))
    if most <= np.iinfo(kind).max:
        ok = b.op("and", BOOL, ok, b.op("le", BOOL, index, kind.type(most)))
    return ok


def changeable(low: Lowering, x: Small, dtype: Any) -> View:
    """x where it may be updated: in place if nothing reads it later, else a copy."""
    if isinstance(x, View) and x.changeable:
        return x
    return owned_copy(low.b, x, dtype)


def _moved(low: Lowering, view: View, starts: Sequence[Value], sizes: Sequence[int]) -> View:
    box = [slice(0, n, 1) for n in sizes]
    return view.sliced(box).moved(low.b, *zip(starts, view.strides, strict=True))


@rule("dynamic_slice")
def _dynamic_slice(low: Lowering, eqn: Any, ins: list) -> list:
    x, sizes = ins[0], eqn.params["slice_sizes"]
    starts = [
        clamped(low, low.scalars(i)[()], n - size)
        for i, n, size in zip(ins[1:], x.shape, sizes, strict=True)
    ]
    if not any(isinstance(s, Var) for s in starts):
        box = tuple(slice(int(s), int(s) + n, 1) for s, n in zip(starts, sizes, strict=True))
        return [x.sliced(box) if isinstance(x, View) else x[box]]
    if not isinstance(x, View) and not is_known(x) and x.size <= SELECT_UP_TO:
        return [_selected(low, x, starts, sizes)]
    return [_moved(low, in_memory(low.b, x, dtype_of(eqn.outvars[0].aval)), starts, sizes)]


def _selected(low: Lowering, x: np.ndarray, starts: list, sizes: Sequence[int]) -> np.ndarray:
    b = low.b
    for axis, (start, size) in enumerate(zip(starts, sizes, strict=True)):
        pieces = [
            np.take(x, range(k, k + size), axis) for k in range(x.shape[axis] - size + 1)
        ]
        out = pieces[-1]
        for k in reversed(range(len(pieces) - 1)):
            here = b.op("eq", BOOL, start, I32.type(k))
            out = objects(out).copy()
            for i in np.ndindex(out.shape):
                out[i] = b.select(here, pieces[k][i], out[i])
        x = out
    return x


@rule("dynamic_update_slice")
def _dynamic_update_slice(low: Lowering, eqn: Any, ins: list) -> list:
    x, update, *index = ins
    dtype = dtype_of(eqn.outvars[0].aval)
    starts = [
        clamped(low, low.scalars(i)[()], n - size)
        for i, n, size in zip(index, x.shape, update.shape, strict=True)
    ]
    if not isinstance(x, View) and not any(isinstance(s, Var) for s in starts):
        out = objects(x).copy()
        box = tuple(slice(int(s), int(s) + n) for s, n in zip(starts, update.shape, strict=True))
        out[box] = low.scalars(update)
        return [out]
    if not isinstance(x, View) and x.size <= SELECT_UP_TO:
        return [_updated(low, objects(x), low.scalars(update), starts)]
    with low.held([update]):
        whole = changeable(low, x, dtype)
    write(low.b, _moved(low, whole, starts, update.shape), update)
    return [whole]


def _updated(low: Lowering, x: np.ndarray, update: np.ndarray, starts: list) -> np.ndarray:
    b, out = low.b, x.copy()
    spans = [range(n - m + 1) for n, m in zip(x.shape, update.shape, strict=True)]
    for at in itertools.product(*spans):
        here: Value = np.bool_(True)
        for start, k in zip(starts, at, strict=True):
            here = b.op("and", BOOL, here, b.op("eq", BOOL, start, I32.type(k)))
        for i in np.ndindex(update.shape):
            to = tuple(np.add(at, i))
            out[to] = b.select(here, update[i], out[to])
    return out


# ------------------------------------------------------------------- gather and scatter


def _starts(low: Lowering, indices: np.ndarray, at: tuple, axes: Sequence[int], rank: int) -> list:
    """Where a window of a gather or scatter begins, one value per axis of the operand."""
    out: list[Value] = [I32.type(0)] * rank
    for k, axis in enumerate(axes):
        out[axis] = indices[(*at, k)]
    return out


def _batch_starts(starts: list, at: tuple, operand_axes: Any, index_axes: Any) -> None:
    for axis, k in zip(operand_axes, index_axes, strict=True):
        starts[axis] = I32.type(at[k])


@rule("gather")
def _gather(low: Lowering, eqn: Any, ins: list) -> list:
    x, P, aval = ins[0], eqn.params, eqn.outvars[0].aval
    dims, sizes, mode = P["dimension_numbers"], P["slice_sizes"], P["mode"]
    if mode not in (
        GatherScatterMode.CLIP,
        GatherScatterMode.FILL_OR_DROP,
        GatherScatterMode.PROMISE_IN_BOUNDS,
    ):
        raise Unsupported(f"gather with mode {mode}")
    if aval.size > 4096:
        raise Unsupported("gather of more than 4096 entries")
    b, indices = low.b, low.scalars(ins[1])
    gone = {*dims.collapsed_slice_dims, *dims.operand_batching_dims}
    window_axes = [axis for axis in range(len(x.shape)) if axis not in gone]
    batch_dims = [k for k in range(len(aval.shape)) if k not in dims.offset_dims]
    most = [n - size for n, size in zip(x.shape, sizes, strict=True)]
    dynamic = any(isinstance(v, Var) for v in indices.flat)
    if dynamic or isinstance(x, View):
        x = in_memory(b, x, dtype_of(aval))
    fill = _fill(P.get("fill_value"), dtype_of(aval))
    out = np.empty(aval.shape, object)
    for at in np.ndindex(*(aval.shape[k] for k in batch_dims)):
        starts = _starts(low, indices, at, dims.start_index_map, len(x.shape))
        _batch_starts(starts, at, dims.operand_batching_dims, dims.start_indices_batching_dims)
        inside: Value = np.bool_(True)
        if mode == GatherScatterMode.FILL_OR_DROP:
            for start, m in zip(starts, most, strict=True):
                inside = b.op("and", BOOL, inside, in_bounds(low, start, m))
        starts = [clamped(low, s, m) for s, m in zip(starts, most, strict=True)]
        corner = x.moved(b, *zip(starts, x.strides, strict=True)) if isinstance(x, View) else x
        for offset in np.ndindex(*(sizes[axis] for axis in window_axes)):
            window = [0] * len(x.shape)
            for axis, k in zip(window_axes, offset, strict=True):
                window[axis] = k
            if isinstance(corner, View):
                step = sum(k * s for k, s in zip(window, corner.strides, strict=True))
                value = b.load(corner.array, corner.base, corner.offset + step)
            else:
                value = corner[tuple(int(s) + k for s, k in zip(starts, window, strict=True))]
            if fill is not None:
                value = b.select(inside, value, fill)
            to: list[int] = [0] * len(aval.shape)
            for k, i in zip(batch_dims, at, strict=True):
                to[k] = i
            for k, i in zip(dims.offset_dims, offset, strict=True):
                to[k] = i
            out[tuple(to)] = value
    return [out]


def _fill(value: Any, dtype: np.dtype) -> Value:
    if value is not None:
        return dtype.type(value)
    if dtype.kind == "f":
        return dtype.type(np.nan)
    if dtype == BOOL:
        return np.bool_(True)
    return dtype.type(np.iinfo(dtype).max if dtype.kind == "u" else np.iinfo(dtype).min)


COMBINE = {
    "scatter": None, "scatter-add": "add", "scatter_add": "add", "scatter_mul": "mul",
    "scatter_min": "min", "scatter_max": "max", "scatter_sub": "sub", "scatter-sub": "sub",
}  # fmt: skip


@rule(*COMBINE)
def _scatter(low: Lowering, eqn: Any, ins: list) -> list:
    x, b, P = ins[0], low.b, eqn.params
    dtype, dims, mode = dtype_of(eqn.outvars[0].aval), P["dimension_numbers"], P["mode"]
    name = COMBINE[eqn.primitive.name]
    combine: Callable = (lambda old, new: new) if name is None else functools.partial(
        b.op, name, dtype
    )  # fmt: skip
    indices, updates = low.scalars(ins[1]), low.scalars(ins[2])
    gone = {*dims.inserted_window_dims, *dims.operand_batching_dims}
    window_axes = [axis for axis in range(len(x.shape)) if axis not in gone]
    batch_dims = [k for k in range(updates.ndim) if k not in dims.update_window_dims]
    sizes = [1] * len(x.shape)
    for axis, k in zip(window_axes, dims.update_window_dims, strict=True):
        sizes[axis] = updates.shape[k]
    most = [n - size for n, size in zip(x.shape, sizes, strict=True)]
    dynamic = any(isinstance(v, Var) for v in indices.flat)
    few = not isinstance(x, View) and x.size <= SELECT_UP_TO
    out = objects(x).copy() if not isinstance(x, View) and (few or not dynamic) else changeable(
        low, x, dtype
    )  # fmt: skip
    for at in np.ndindex(*(updates.shape[k] for k in batch_dims)):
        starts = _starts(low, indices, at, dims.scatter_dims_to_operand_dims, len(x.shape))
        _batch_starts(starts, at, dims.operand_batching_dims, dims.scatter_indices_batching_dims)
        inside: Value = np.bool_(True)
        if mode == GatherScatterMode.CLIP:
            starts = [clamped(low, s, m) for s, m in zip(starts, most, strict=True)]
        elif mode != GatherScatterMode.PROMISE_IN_BOUNDS:
            for start, m in zip(starts, most, strict=True):
                inside = b.op("and", BOOL, inside, in_bounds(low, start, m))
        if not isinstance(inside, Var) and not inside:
            continue
        window = np.empty(sizes, object)
        for offset in np.ndindex(*(updates.shape[k] for k in dims.update_window_dims)):
            to, place = [0] * len(x.shape), [0] * updates.ndim
            for axis, k in zip(window_axes, offset, strict=True):
                to[axis] = k
            for k, i in zip(dims.update_window_dims, offset, strict=True):
                place[k] = i
            for k, i in zip(batch_dims, at, strict=True):
                place[k] = i
            window[tuple(to)] = updates[tuple(place)]
        if isinstance(out, View):
            _stored(low, out, window, starts, inside, combine, most)
        else:
            out = _merged(low, out, window, starts, inside, combine)
    return [tidy(out, dtype) if isinstance(out, np.ndarray) else out]


def _stored(
    low: Lowering, out: View, window: np.ndarray, starts: list, inside: Value, combine: Callable,
    most: list[int],
) -> None:  # fmt: skip
    b = low.b

    def store() -> None:
        safe = [clamped(low, s, m) for s, m in zip(starts, most, strict=True)]
        corner = out.moved(b, *zip(safe, out.strides, strict=True))
        for k in np.ndindex(window.shape):
            offset = corner.offset + sum(i * s for i, s in zip(k, corner.strides, strict=True))
            old = b.load(corner.array, corner.base, offset)
            b.store(corner.array, corner.base, offset, combine(old, window[k]))

    if not isinstance(inside, Var):
        store()
        return
    with b.when(inside):
        store()


def _merged(
    low: Lowering, x: np.ndarray, window: np.ndarray, starts: list, inside: Value, combine: Callable
) -> np.ndarray:
    b, out = low.b, x.copy()
    spans = [
        [int(s)] if not isinstance(s, Var) else range(n - m + 1)
        for s, n, m in zip(starts, x.shape, window.shape, strict=True)
    ]
    for at in itertools.product(*spans):
        here = inside
        for start, k in zip(starts, at, strict=True):
            if isinstance(start, Var):
                here = b.op("and", BOOL, here, b.op("eq", BOOL, start, start.dtype.type(k)))
        for i in np.ndindex(window.shape):
            to = tuple(np.add(at, i))
            out[to] = b.select(here, combine(x[to], window[i]), out[to])
    return out
