"""Lowering rules for gather and scatter. A few entries are unrolled; many use loops over memory."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jax.lax import GatherScatterMode

from rbjax.compiler.ir.statements import BOOL, I32, Unsupported, Value, Var
from rbjax.compiler.lower import arrays
from rbjax.compiler.lower.arrays import View
from rbjax.compiler.lower.elementwise import LOOP_ABOVE
from rbjax.compiler.lower.indexing import SELECT_UP_TO, clamp, is_in_bounds, make_updatable
from rbjax.compiler.lower.lowering import Equation, Lowering, dtype_of, rule

FILL = GatherScatterMode.FILL_OR_DROP


def _starts(low: Lowering, indices: np.ndarray, at: tuple, axes: Sequence[int], rank: int) -> list:
    """Return the start index of one window, one value per axis of the operand.
    at: the position of the window in the batch of index vectors."""
    out: list[Value] = [I32.type(0)] * rank
    for k, axis in enumerate(axes):
        out[axis] = indices[(*at, k)]
    return out


def _batch_starts(
    starts: list, at: tuple, operand_axes: Sequence[int], index_axes: Sequence[int]
) -> None:
    for axis, k in zip(operand_axes, index_axes, strict=True):
        starts[axis] = at[k] if isinstance(at[k], Var) else I32.type(at[k])


def _all_in_bounds(low: Lowering, starts: list, most: list[int]) -> Value:
    inside: Value = np.bool_(True)
    for start, m in zip(starts, most, strict=True):
        inside = low.b.op("and", BOOL, inside, is_in_bounds(low, start, m))
    return inside


@rule("gather")
def _gather(low: Lowering, eqn: Equation, ins: list) -> list:
    x, P, aval = ins[0], eqn.params, eqn.outvars[0].aval
    dims, sizes, mode = P["dimension_numbers"], P["slice_sizes"], P["mode"]
    if mode not in (GatherScatterMode.CLIP, FILL, GatherScatterMode.PROMISE_IN_BOUNDS):
        raise Unsupported(f"gather with mode {mode}")
    if aval.size > LOOP_ABOVE:
        return [_gather_looped(low, eqn, ins)]
    b, indices = low.b, low.to_scalars(ins[1])
    gone = {*dims.collapsed_slice_dims, *dims.operand_batching_dims}
    window_axes = [axis for axis in range(len(x.shape)) if axis not in gone]
    batch_dims = [k for k in range(len(aval.shape)) if k not in dims.offset_dims]
    most = [n - size for n, size in zip(x.shape, sizes, strict=True)]
    dynamic = any(isinstance(v, Var) for v in indices.flat)
    if dynamic or isinstance(x, View):
        x = arrays.to_memory(b, x, dtype_of(aval))
    fill = _fill(P.get("fill_value"), dtype_of(aval))
    out = np.empty(aval.shape, object)
    for at in arrays.indices_of([*(aval.shape[k] for k in batch_dims)]):
        starts = _starts(low, indices, at, dims.start_index_map, len(x.shape))
        _batch_starts(starts, at, dims.operand_batching_dims, dims.start_indices_batching_dims)
        inside = _all_in_bounds(low, starts, most) if mode == FILL else np.bool_(True)
        starts = [clamp(low, s, m) for s, m in zip(starts, most, strict=True)]
        corner = x.shift(b, *zip(starts, x.strides, strict=True)) if isinstance(x, View) else x
        for offset in arrays.indices_of([*(sizes[axis] for axis in window_axes)]):
            window = [0] * len(x.shape)
            for axis, k in zip(window_axes, offset, strict=True):
                window[axis] = k
            if isinstance(corner, View):
                step = sum(k * s for k, s in zip(window, corner.strides, strict=True))
                value = b.load(corner.array, corner.base, corner.offset + step)
            else:
                value = corner[tuple(int(s) + k for s, k in zip(starts, window, strict=True))]
            value = b.select(inside, value, fill)
            to: list[int] = [0] * len(aval.shape)
            for k, i in zip(batch_dims, at, strict=True):
                to[k] = i
            for k, i in zip(dims.offset_dims, offset, strict=True):
                to[k] = i
            out[tuple(to)] = value
    return [out]


def _place(
    low: Lowering, indices: View, at: tuple, axes: Sequence[int], batching: tuple, offsets: dict,
    most: list[int], mode: Any,
) -> tuple[list[Value], Value]:  # fmt: skip
    """Return the operand's index of one entry of a window, and whether the window is in bounds.
    offsets: for each window axis, the offset of the entry in the window."""
    starts: list[Value] = [I32.type(0)] * len(most)
    for k, axis in enumerate(axes):
        starts[axis] = arrays.load_entry(low.b, indices, (*at, I32.type(k)))
    _batch_starts(starts, at, *batching)
    inside = _all_in_bounds(low, starts, most) if mode == FILL else np.bool_(True)
    place = [clamp(low, s, m) for s, m in zip(starts, most, strict=True)]
    for axis, offset in offsets.items():
        place[axis] = low.b.op("index_add", I32, place[axis], offset)
    return place, inside


def _gather_looped(low: Lowering, eqn: Equation, ins: list) -> View:
    P, aval, b = eqn.params, eqn.outvars[0].aval, low.b
    dims, mode, dtype = P["dimension_numbers"], P["mode"], dtype_of(aval)
    x, indices = (
        arrays.to_memory(b, x, dtype_of(v.aval)) for x, v in zip(ins, eqn.invars, strict=True)
    )
    gone = {*dims.collapsed_slice_dims, *dims.operand_batching_dims}
    window_axes = [axis for axis in range(x.ndim) if axis not in gone]
    batch_dims = [k for k in range(len(aval.shape)) if k not in dims.offset_dims]
    most = [n - size for n, size in zip(x.shape, P["slice_sizes"], strict=True)]
    out = View.of(b.local(dtype, aval.size), aval.shape)

    def one(*to: Value) -> None:
        at = tuple(to[k] for k in batch_dims)
        batching = dims.operand_batching_dims, dims.start_indices_batching_dims
        offsets = {axis: to[k] for axis, k in zip(window_axes, dims.offset_dims, strict=True)}
        place, inside = _place(
            low, indices, at, dims.start_index_map, batching, offsets, most, mode
        )
        value = arrays.load_entry(b, x, place)
        arrays.store_entry(b, out, to, b.select(inside, value, _fill(P.get("fill_value"), dtype)))

    arrays.for_each_index(b, aval.shape, one)
    return out


def _fill(value: Any, dtype: np.dtype) -> Value:
    if value is not None:
        return dtype.type(value)
    if dtype.kind == "f":
        return dtype.type(np.nan)
    if dtype == BOOL:
        return np.bool_(True)
    return dtype.type(np.iinfo(dtype).max if dtype.kind == "u" else np.iinfo(dtype).min)


COMBINE = {
    "scatter": None, "scatter-add": "add", "scatter-sub": "sub", "scatter-mul": "mul",
    "scatter-min": "min", "scatter-max": "max",
}  # fmt: skip


@rule(*COMBINE)
def _scatter(low: Lowering, eqn: Equation, ins: list) -> list:
    x, P = ins[0], eqn.params
    dtype, dims, mode = dtype_of(eqn.outvars[0].aval), P["dimension_numbers"], P["mode"]
    combine = _combination(low, eqn)
    if eqn.invars[2].aval.size > LOOP_ABOVE:
        return [_scatter_looped(low, eqn, ins, combine)]
    indices, updates = low.to_scalars(ins[1]), low.to_scalars(ins[2])
    gone = {*dims.inserted_window_dims, *dims.operand_batching_dims}
    window_axes = [axis for axis in range(len(x.shape)) if axis not in gone]
    batch_dims = [k for k in range(updates.ndim) if k not in dims.update_window_dims]
    sizes = [1] * len(x.shape)
    for axis, k in zip(window_axes, dims.update_window_dims, strict=True):
        sizes[axis] = updates.shape[k]
    most = [n - size for n, size in zip(x.shape, sizes, strict=True)]
    dynamic = any(isinstance(v, Var) for v in indices.flat)
    in_registers = not isinstance(x, View) and (x.size <= SELECT_UP_TO or not dynamic)
    out = arrays.as_objects(x).copy() if in_registers else make_updatable(low, x, dtype)
    for at in arrays.indices_of([*(updates.shape[k] for k in batch_dims)]):
        starts = _starts(low, indices, at, dims.scatter_dims_to_operand_dims, len(x.shape))
        _batch_starts(starts, at, dims.operand_batching_dims, dims.scatter_indices_batching_dims)
        inside: Value = np.bool_(True)
        if mode == GatherScatterMode.CLIP:
            starts = [clamp(low, s, m) for s, m in zip(starts, most, strict=True)]
        elif mode != GatherScatterMode.PROMISE_IN_BOUNDS:
            inside = _all_in_bounds(low, starts, most)
        if not isinstance(inside, Var) and not inside:
            continue
        window = np.empty(sizes, object)
        for offset in arrays.indices_of([*(updates.shape[k] for k in dims.update_window_dims)]):
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
    return [arrays.fold_if_constant(out, dtype) if isinstance(out, np.ndarray) else out]


def _combination(low: Lowering, eqn: Equation) -> Callable[[Value, Value], Value]:
    """Return the function that combines the old entry with its update."""
    name, update = COMBINE[eqn.primitive.name], eqn.params["update_jaxpr"]
    if name is not None:
        return functools.partial(low.b.op, name, dtype_of(eqn.outvars[0].aval))
    if update is None or not update.eqns:
        return lambda old, new: new

    def applied(old: Value, new: Value) -> Value:
        pair = [arrays.full_of((), old), arrays.full_of((), new)]
        return low.to_scalar(low.run(update, eqn.params["update_consts"], pair)[0])

    return applied


def _scatter_looped(low: Lowering, eqn: Equation, ins: list, combine: Callable) -> View:
    P, b = eqn.params, low.b
    dims, mode = P["dimension_numbers"], P["mode"]
    indices, updates = (
        arrays.to_memory(b, x, dtype_of(v.aval))
        for x, v in zip(ins[1:], eqn.invars[1:], strict=True)
    )
    with low.pinned([indices, updates]):
        out = make_updatable(low, ins[0], dtype_of(eqn.outvars[0].aval))
    gone = {*dims.inserted_window_dims, *dims.operand_batching_dims}
    window_axes = [axis for axis in range(out.ndim) if axis not in gone]
    batch_dims = [k for k in range(updates.ndim) if k not in dims.update_window_dims]
    sizes = [1] * out.ndim
    for axis, k in zip(window_axes, dims.update_window_dims, strict=True):
        sizes[axis] = updates.shape[k]
    most = [n - size for n, size in zip(out.shape, sizes, strict=True)]

    def one(*source: Value) -> None:
        at = tuple(source[k] for k in batch_dims)
        batching = dims.operand_batching_dims, dims.scatter_indices_batching_dims
        window = zip(window_axes, dims.update_window_dims, strict=True)
        offsets = {axis: source[k] for axis, k in window}
        place, inside = _place(
            low, indices, at, dims.scatter_dims_to_operand_dims, batching, offsets, most, mode
        )
        new = arrays.load_entry(b, updates, source)
        with b.when(inside):
            arrays.store_entry(b, out, place, combine(arrays.load_entry(b, out, place), new))

    with b.per_thread():  # in one thread: several updates may write the same entry
        arrays.for_each_index(b, updates.shape, one)
    return out


def _stored(
    low: Lowering, out: View, window: np.ndarray, starts: list, inside: Value, combine: Callable,
    most: list[int],
) -> None:  # fmt: skip
    b = low.b

    def store() -> None:
        safe = [clamp(low, s, m) for s, m in zip(starts, most, strict=True)]
        corner = out.shift(b, *zip(safe, out.strides, strict=True))
        for k in arrays.indices_of(window.shape):
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
        for i in arrays.indices_of(window.shape):
            to = tuple(np.add(at, i))
            out[to] = b.select(here, combine(x[to], window[i]), out[to])
    return out
