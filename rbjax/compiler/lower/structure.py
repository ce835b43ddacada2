"""Lowering rules for primitives that only move entries."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rbjax.compiler.lower import arrays
from rbjax.compiler.lower.arrays import ThreadArray, View
from rbjax.compiler.lower.delayed import Delayed
from rbjax.compiler.lower.elementwise import LOOP_ABOVE
from rbjax.compiler.lower.lowering import (
    Equation,
    Lowering,
    accepts_delayed,
    dtype_of,
    placing_rule,
    rule,
)

accepts_delayed(
    "fusion_barrier", "copy", "copy_p", "stop_gradient", "name", "batch_first", "batch_last",
    "slice", "squeeze", "reshape", "expand_dims", "transpose", "rev", "broadcast_in_dim",
    "concatenate", "stack", "split", "unstack",
)  # fmt: skip


@rule("fusion_barrier", "copy", "copy_p", "stop_gradient",
      "optimization_barrier", "device_put", "sharding_constraint", "name", "pvary", "reshard",
      "nonbatchable",
      "nondifferentiable_backward", "nontraceable")  # fmt: skip
def _identity(low: Lowering, eqn: Equation, ins: list) -> list:
    return list(ins)


@rule("batch_first", "batch_last")
def _first(low: Lowering, eqn: Equation, ins: list) -> list:
    return ins[:1]


@rule("slice")
def _slice(low: Lowering, eqn: Equation, ins: list) -> list:
    P = eqn.params
    steps = P["strides"] or [1] * len(P["start_indices"])
    box = tuple(map(slice, P["start_indices"], P["limit_indices"], steps))
    return [cut(low, ins[0], box)]


def cut(low: Lowering, x: ThreadArray, box: tuple[slice, ...]) -> ThreadArray:
    """Return a rectangular part of x."""
    if isinstance(x, Delayed):
        return x.slice_box(low.b, box)
    return x.slice_box(box) if isinstance(x, View) else x[box]


@rule("squeeze", "reshape", "expand_dims")
def _reshape(low: Lowering, eqn: Equation, ins: list) -> list:
    return [reshaped(low, ins[0], eqn.outvars[0].aval.shape)]


def reshaped(low: Lowering, x: ThreadArray, shape: tuple[int, ...]) -> ThreadArray:
    """Return x with another shape. Entries are copied only if they cannot be viewed."""
    if isinstance(x, Delayed):
        delayed = x.reshape_view(shape)
        if delayed is not None:
            return delayed
        x = arrays.materialize_in_memory(low.b, x)
    if isinstance(x, View):
        out = x.reshape_view(shape)
        return (
            View.of(arrays.copy_to_memory(low.b, x, x.dtype).array, shape) if out is None else out
        )
    return x.reshape(shape)


@rule("transpose")
def _transpose(low: Lowering, eqn: Equation, ins: list) -> list:
    return [arrays.transposed(ins[0], eqn.params["permutation"])]


@rule("rev")
def _rev(low: Lowering, eqn: Equation, ins: list) -> list:
    x, axes = ins[0], eqn.params["dimensions"]
    if isinstance(x, np.ndarray):
        return [np.flip(x, axes)]
    box = [slice(n - 1, -1, -1) if k in axes else slice(0, n, 1) for k, n in enumerate(x.shape)]
    return [cut(low, x, tuple(box))]


@rule("broadcast_in_dim")
def _broadcast(low: Lowering, eqn: Equation, ins: list) -> list:
    x, shape, axes = ins[0], eqn.params["shape"], eqn.params["broadcast_dimensions"]
    if not isinstance(x, np.ndarray):
        return [x.broadcast(shape, axes)]
    wide = [1] * len(shape)
    for k, axis in enumerate(axes):
        wide[axis] = x.shape[k]
    return [np.broadcast_to(x.reshape(wide), shape)]


@placing_rule("concatenate")
def _concatenate(low: Lowering, eqn: Equation, ins: list, places: list) -> list:
    return [_joined(low, eqn, ins, eqn.params["dimension"], places[0])]


@placing_rule("stack")
def _stack(low: Lowering, eqn: Equation, ins: list, places: list) -> list:
    axis = eqn.params.get("axis", eqn.params.get("dimension", 0))
    shape = list(eqn.outvars[0].aval.shape)
    shape[axis] = 1
    rows = [reshaped(low, x, tuple(shape)) for x in ins]
    return [_joined(low, eqn, rows, axis, places[0])]


def _joined(low: Lowering, eqn: Equation, ins: list, axis: int, place: View | None) -> ThreadArray:
    """Return the concatenation of arrays along an axis: in memory if it is large or has a place
    there, else in registers."""
    out = eqn.outvars[0].aval
    whole = _pieces_of_one(ins, axis) if low.b.in_team else None
    if place is None and whole is not None:
        return whole
    if place is None and out.size > (arrays.FEW if low.b.in_team else LOOP_ABOVE):
        place = View.of(low.b.local(out.dtype, out.size), out.shape)
    if place is None:
        values = np.concatenate([low.to_scalars(x) for x in ins], axis)
        return arrays.fold_if_constant(values, out.dtype)
    start = 0
    with low.b.disjoint_writes():
        for x in ins:
            box = [slice(0, n, 1) for n in place.shape]
            box[axis] = slice(start, start + x.shape[axis], 1)
            arrays.write_to(low.b, place.slice_box(box), x)
            start += x.shape[axis]
    return place


def _pieces_of_one(xs: list, axis: int) -> View | None:
    """Return equally spaced pieces of one array as one view; None if they are not."""
    first = xs[0]
    if not all(isinstance(x, View) and x.array is first.array for x in xs):
        return None
    at, step, strides = first.offset, first.strides[axis], list(first.strides)
    if len(xs) > 1 and all(x.shape[axis] == 1 for x in xs):  # rows, at any distance
        step = strides[axis] = xs[1].offset - first.offset
    for x in xs:
        same = x.base is first.base and x.offset == at and x.strides == first.strides
        if not same:
            return None
        at += x.shape[axis] * step
    shape = list(first.shape)
    shape[axis] = sum(x.shape[axis] for x in xs)
    return View(first.array, first.base, first.offset, tuple(strides), tuple(shape))


@rule("tile")
def _tile(low: Lowering, eqn: Equation, ins: list) -> list:
    return [np.tile(low.to_scalars(ins[0]), eqn.params["reps"])]


@rule("unstack")
def _unstack(low: Lowering, eqn: Equation, ins: list) -> list:
    axis = eqn.params.get("axis", eqn.params.get("dimension", 0))
    return _split(low, ins[0], axis, [1] * ins[0].shape[axis], squeeze=True)


@rule("split")
def _splits(low: Lowering, eqn: Equation, ins: list) -> list:
    return _split(low, ins[0], eqn.params["axis"], eqn.params["sizes"])


def _split(
    low: Lowering, x: ThreadArray, axis: int, sizes: Sequence[int], squeeze: bool = False
) -> list:
    out, start = [], 0
    for size in sizes:
        box = [slice(0, n, 1) for n in x.shape]
        box[axis] = slice(start, start + size, 1)
        part = cut(low, x, tuple(box))
        shape = tuple(n for k, n in enumerate(part.shape) if k != axis)
        out.append(reshaped(low, part, shape) if squeeze else part)
        start += size
    return out


@rule("pad")
def _pad(low: Lowering, eqn: Equation, ins: list) -> list:
    x, fill = low.to_scalars(ins[0]), low.to_scalar(ins[1])
    config = eqn.params["padding_config"]
    # put gaps between entries, then pad or (if negative) cut the sides
    spread = [max(n + (n - 1) * gap, 0) for n, (_, _, gap) in zip(x.shape, config, strict=True)]
    wide = arrays.full_of(spread, fill)
    wide[tuple(slice(None, None, gap + 1) for _, _, gap in config)] = x
    for axis, (before, after, _) in enumerate(config):
        for side, amount in ((0, before), (1, after)):
            if amount > 0:
                shape = list(wide.shape)
                shape[axis] = amount
                more = arrays.full_of(shape, fill)
                wide = np.concatenate([wide, more] if side else [more, wide], axis)
            elif amount < 0:
                cut = slice(None, amount) if side else slice(-amount, None)
                wide = wide[tuple(cut if k == axis else slice(None) for k in range(wide.ndim))]
    return [wide]


@rule("iota", "full")
def _constant(low: Lowering, eqn: Equation, ins: list) -> list:
    aval, P = eqn.outvars[0].aval, eqn.params
    if eqn.primitive.name == "full":
        return [np.full(aval.shape, P["fill_value"], aval.dtype)]
    axis = P["dimension"]
    row = np.arange(aval.shape[axis], dtype=aval.dtype)
    shape = [-1 if k == axis else 1 for k in range(len(aval.shape))]
    return [np.broadcast_to(row.reshape(shape), aval.shape)]


@rule("empty", "empty2")
def _unset(low: Lowering, eqn: Equation, ins: list) -> list:
    """Return memory that the program writes before it reads it."""
    aval = eqn.outvars[0].aval
    if aval.size <= arrays.FEW:
        return [np.zeros(aval.shape, aval.dtype)]
    return [View.of(low.b.local(dtype_of(aval), aval.size), aval.shape)]
