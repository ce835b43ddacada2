"""JAX's indexing by numpy: slices, gathers and scatters (`tests.numpy_rules`)."""

from __future__ import annotations

from typing import Any

import numpy as np
from jax.lax import GatherScatterMode as Mode

from tests.numpy_rules import rule, shape_of


def _first(starts: Any, shape: tuple[int, ...], sizes: tuple[int, ...]) -> tuple[slice, ...]:
    """The part of these sizes that begins at `starts`, moved inside the array."""
    begin = [min(max(int(i), 0), n - s) for i, n, s in zip(starts, shape, sizes, strict=True)]
    return tuple(slice(i, i + s) for i, s in zip(begin, sizes, strict=True))


@rule("dynamic_slice")
def _dynamic_slice(eqn):
    shape, sizes = eqn.invars[0].aval.shape, eqn.params["slice_sizes"]
    return lambda x, *starts: x[_first(starts, shape, sizes)]


@rule("dynamic_update_slice")
def _dynamic_update_slice(eqn):
    shape, sizes = (v.aval.shape for v in eqn.invars[:2])

    def run(x: Any, new: Any, *starts: Any) -> Any:
        out = np.array(x)
        out[_first(starts, shape, sizes)] = new
        return out

    return run


KNOWN = (Mode.CLIP, Mode.PROMISE_IN_BOUNDS, Mode.FILL_OR_DROP)


def _places(where, shape, sizes, indexed, alone, dropped, offsets, clip):
    """Indices of all entries of windows, one array an axis of the array, and which are inside.

    `where` has a row of `indexed` axes' starts for each window; `alone` are pairs of axes of the
    array and of `where` that go together; `offsets` are the result's axes along the windows.
    """
    rank = where.ndim - 1 + len(offsets)
    outer = [k for k in range(rank) if k not in offsets]
    along = iter(offsets)

    def spread(x: Any, axes: list[int]) -> Any:
        full = [1] * rank
        for k, size in zip(axes, x.shape, strict=True):
            full[k] = size
        return x.reshape(full)

    inside: Any = True
    found = []
    for axis, (n, size) in enumerate(zip(shape, sizes, strict=True)):
        start: Any = np.zeros((1,) * rank, np.int64)
        if axis in indexed:
            start = spread(where[..., indexed.index(axis)].astype(np.int64), outer)
            if not clip:
                inside = inside & (start >= 0) & (start <= n - size)
            start = np.clip(start, 0, n - size)
        elif axis in alone:
            b = alone[axis]
            start = spread(np.arange(where.shape[b]), [outer[b]])
        if axis not in dropped and axis not in alone:
            start = start + spread(np.arange(size), [next(along)])
        found.append(start)
    return tuple(found), inside


def _nothing(dtype: np.dtype) -> Any:
    """What JAX fills with where an index is outside."""
    match dtype.kind:
        case "i":
            return np.iinfo(dtype).min
        case "u":
            return np.iinfo(dtype).max
        case "b":
            return True
    return np.nan


@rule("gather")
def _gather(eqn):
    p, d = eqn.params, eqn.params["dimension_numbers"]
    given, shape, mode = eqn.invars[0].aval, shape_of(eqn), p["mode"]
    alone = dict(zip(d.operand_batching_dims, d.start_indices_batching_dims, strict=True))
    if mode not in KNOWN or given.size == 0:
        return None
    how = (given.shape, p["slice_sizes"], d.start_index_map, alone, d.collapsed_slice_dims,
           d.offset_dims, mode != Mode.FILL_OR_DROP)  # fmt: skip
    fill = _nothing(given.dtype) if p["fill_value"] is None else p["fill_value"]

    def run(x: Any, where: Any) -> Any:
        places, inside = _places(where, *how)
        out = np.broadcast_to(x[places], shape)
        return out if inside is True else np.where(inside, out, np.asarray(fill, x.dtype))

    return run


COMBINED = {"scatter": None, "scatter-add": np.add, "scatter-mul": np.multiply,
            "scatter-max": np.maximum, "scatter-min": np.minimum}  # fmt: skip


@rule(*COMBINED)
def _scatter(eqn):
    p, d = eqn.params, eqn.params["dimension_numbers"]
    given, new, mode = eqn.invars[0].aval, eqn.invars[2].aval, p["mode"]
    alone = dict(zip(d.operand_batching_dims, d.scatter_indices_batching_dims, strict=True))
    if mode not in KNOWN or given.size == 0:
        return None
    windows = iter(new.shape[k] for k in d.update_window_dims)
    single = {*d.inserted_window_dims, *alone}
    sizes = tuple(1 if k in single else next(windows) for k in range(given.ndim))
    how = (given.shape, sizes, d.scatter_dims_to_operand_dims, alone, d.inserted_window_dims,
           d.update_window_dims, mode != Mode.FILL_OR_DROP)  # fmt: skip
    f = COMBINED[eqn.primitive.name]

    def run(x: Any, where: Any, values: Any) -> Any:
        places, inside = _places(where, *how)
        out = np.array(x)
        if inside is not True:
            kept = np.broadcast_to(inside, new.shape)
            places = tuple(np.broadcast_to(i, new.shape)[kept] for i in places)
            values = np.asarray(values)[kept]
        if f is None:
            out[places] = values
        else:
            f.at(out, places, values)
        return out

    return run
