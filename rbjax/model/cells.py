"""Cells: entries of numpy object arrays that follow the algebra of lanes.

With them the whole-array code of `prepare` runs number by number where a model's zeros are declared
part of the program (`Model.fix_zeros`): products with a zero vanish, the rest is traced.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, add, is_literal, mul, neg, sub


class Cell:
    """One lane inside an object array."""

    __slots__ = ("lane",)

    def __init__(self, lane: Lane):
        self.lane = lane

    def __add__(self, other: Any) -> Cell:
        return Cell(add(self.lane, lane_of(other)))

    __radd__ = __add__

    def __sub__(self, other: Any) -> Cell:
        return Cell(sub(self.lane, lane_of(other)))

    def __rsub__(self, other: Any) -> Cell:
        return Cell(sub(lane_of(other), self.lane))

    def __mul__(self, other: Any) -> Cell:
        return Cell(mul(self.lane, lane_of(other)))

    __rmul__ = __mul__

    def __rtruediv__(self, other: Any) -> Cell:
        return Cell(lane_of(other) / self.lane)

    def __neg__(self) -> Cell:
        return Cell(neg(self.lane))


def lane_of(x: Any) -> Lane:
    """The lane of a cell, or a number as a literal."""
    return x.lane if isinstance(x, Cell) else float(x)


def literals(x: Any, *, units: bool) -> tuple[float | None, ...]:
    """For each entry of an array, of numbers or cells, its value where that is 0 (or 1 or -1, with
    `units`)."""
    known = (0.0, 1.0, -1.0) if units else (0.0,)
    lanes = map(lane_of, np.asarray(x).ravel())
    return tuple(v if is_literal(v) and v in known else None for v in lanes)


def declared(x: Any, pattern: tuple[float | None, ...]) -> Any:
    """An array with the pattern's values where it has them: numpy, unless x is traced."""
    xp = jnp if isinstance(x, jax.core.Tracer) else np
    values = np.array([np.nan if v is None else v for v in pattern], x.dtype).reshape(x.shape)
    return xp.where(np.isnan(values), x, values)


def cells(x: Any, pattern: tuple[float | None, ...], known: bool) -> np.ndarray:
    """An array as an object array: literals where the pattern has them, or where x is known."""
    if known:
        return declared(np.asarray(x, np.float64), pattern).astype(object)
    out = np.empty(len(pattern), object)
    flat = x.reshape(-1)
    for i, value in enumerate(pattern):
        out[i] = Cell(flat[i]) if value is None else value
    return out.reshape(x.shape)


def cast_cells(x: np.ndarray, dtype: Any) -> np.ndarray:
    """An object array with what is traced in the given dtype."""
    out = [Cell(c.lane.astype(dtype)) if isinstance(c, Cell) and not is_literal(c.lane) else c
           for c in x.ravel()]  # fmt: skip
    return np.fromiter(out, object, len(out)).reshape(x.shape)


@jax.tree_util.register_pytree_node_class
class Sparse:
    """A column as a pytree: its zeros (and ones) part of the program, the other numbers not."""

    def __init__(self, pattern: tuple[float | None, ...], others: Any):
        self.pattern, self.others = pattern, others

    @classmethod
    def of(cls, column: Any, dtype: Any, *, units: bool = False) -> Sparse:
        """Of numbers, of cells, or of a traced column, of which nothing is known."""
        if isinstance(column, jax.Array):
            return cls((None,) * column.shape[0], column.astype(dtype))
        pattern = literals(column, units=units)
        others = [lane_of(x) for x, known in zip(column, pattern, strict=True) if known is None]
        if all(map(is_literal, others)):
            return cls(pattern, np.array(others, dtype))
        return cls(pattern, jnp.stack([jnp.asarray(x, dtype) for x in others]))

    def column(self) -> Any:
        """The column, of literals and cells; the array itself if no entry is known."""
        if all(x is None for x in self.pattern):
            return self.others
        others = iter(self.others)
        return np.array([Cell(next(others)) if x is None else x for x in self.pattern], object)

    def tree_flatten(self) -> tuple[tuple, tuple]:
        return (self.others,), self.pattern

    @classmethod
    def tree_unflatten(cls, pattern: tuple, children: tuple) -> Sparse:
        return cls(pattern, *children)


def stacked(x: Any, dtype: Any) -> Any:
    """An object array as an array; any other as it is."""
    if x.dtype != object:
        return jnp.asarray(x, dtype)
    rows = [jnp.asarray(lane_of(v), dtype) for v in x.ravel()]
    return jnp.stack(rows).reshape(x.shape) if rows else jnp.zeros(x.shape, dtype)


def all_literal(row: Any) -> bool:
    """Whether every entry is a number."""
    return all(is_literal(lane_of(v)) for v in row)
