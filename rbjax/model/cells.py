"""Link constants entry by entry, if some leaves are known or fixed and others are traced.

A cell is an entry of a numpy object array with the algebra of lanes. With cells the whole-array
code of `prepare` runs number by number: products with a known zero vanish, the rest is traced.
`Model.fix_zeros` makes entries of leaves known.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, add, is_literal, mul, neg, sub
from rbjax.model.record import Record


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
    """The values of the entries that are 0 (with `units`, also 1 or -1), None for the others."""
    known = (0.0, 1.0, -1.0) if units else (0.0,)
    lanes = map(lane_of, np.asarray(x).ravel())
    return tuple(v if is_literal(v) and v in known else None for v in lanes)


def with_pattern(x: Any, pattern: tuple[float | None, ...]) -> Any:
    """Replace the entries of an array that a pattern of `literals` fixes."""
    xp = jnp if isinstance(x, jax.core.Tracer) else np
    values = np.array([np.nan if v is None else v for v in pattern], x.dtype).reshape(x.shape)
    return xp.where(np.isnan(values), x, values)


def cells(x: Any, pattern: tuple[float | None, ...], known: bool) -> np.ndarray:
    """Convert an array to an object array of literals, if known or fixed, and cells."""
    if known:
        return with_pattern(np.asarray(x, np.float64), pattern).astype(object)
    out = np.empty(len(pattern), object)
    flat = x.reshape(-1)
    for i, value in enumerate(pattern):
        out[i] = Cell(flat[i]) if value is None else value
    return out.reshape(x.shape)


def cast_cells(x: np.ndarray, dtype: Any) -> np.ndarray:
    """Convert the traced entries of an object array to a dtype."""
    out = [Cell(c.lane.astype(dtype)) if isinstance(c, Cell) and not is_literal(c.lane) else c
           for c in x.ravel()]  # fmt: skip
    return np.fromiter(out, object, len(out)).reshape(x.shape)


@jax.tree_util.register_pytree_node_class
class Sparse:
    """A column as a pytree: zeros (and ones) are part of the program, the others are leaves."""

    def __init__(self, pattern: tuple[float | None, ...], others: Any):
        self.pattern, self.others = pattern, others

    @classmethod
    def of(cls, column: Any, dtype: Any, *, units: bool = False) -> Sparse:
        """From numbers, cells, or a traced column."""
        if isinstance(column, jax.Array):
            return cls((None,) * column.shape[0], column.astype(dtype))
        pattern = literals(column, units=units)
        others = [lane_of(x) for x, known in zip(column, pattern, strict=True) if known is None]
        if all(map(is_literal, others)):
            return cls(pattern, np.array(others, dtype))
        return cls(pattern, jnp.stack([jnp.asarray(x, dtype) for x in others]))

    def column(self) -> Any:
        """The column, as literals and cells, or as an array if no entry is known."""
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
    """Convert an object array to an array."""
    if x.dtype != object:
        return jnp.asarray(x, dtype)
    rows = [jnp.asarray(lane_of(v), dtype) for v in x.ravel()]
    return jnp.stack(rows).reshape(x.shape) if rows else jnp.zeros(x.shape, dtype)


def all_literal(row: Any) -> bool:
    """Whether every entry is a number."""
    return all(is_literal(lane_of(v)) for v in row)


#: the leaves of bodies and joints from which, with gravity, the link constants follow
_CONSTANTS = (
    "mass", "com", "inertia", "position", "orientation",
    "placement", "axis", "reference", "armature", "params",
)  # fmt: skip


def constant_leaves(model: Any) -> dict[str, Any]:
    """The leaves from which the link constants follow."""
    leaves = _fields(model.bodies) | _fields(model.joints)
    return {name: leaves[name] for name in _CONSTANTS} | {"gravity": model.gravity}


def with_fixed_entries(changes: dict[str, Any], zeros: dict[str, tuple]) -> dict[str, Any]:
    """Reset every fixed entry of changed leaves to its fixed value."""

    def record(r: Record) -> Record:
        given = {n: x for n, x in _fields(r).items() if n in zeros}
        return dataclasses.replace(r, **{n: with_pattern(x, zeros[n]) for n, x in given.items()})

    out: dict[str, Any] = {n: record(changes[n]) for n in ("bodies", "joints") if n in changes}
    if "gravity" in changes:
        out["gravity"] = with_pattern(changes["gravity"], zeros["gravity"])
    return out


def _fields(record: Record) -> dict[str, jax.Array]:
    return {f.name: getattr(record, f.name) for f in dataclasses.fields(record)}


def known_entries(model: Any) -> tuple[tuple[str, tuple[float | None, ...]], ...]:
    """The entries of each leaf that are zero (or one, of axes and attitudes), else None."""
    leaves = constant_leaves(model)
    return tuple(
        (
            name,
            (None,) * x.size
            if isinstance(x, jax.core.Tracer)
            else literals(x, units=name in ("axis", "orientation")),
        )
        for name, x in leaves.items()
    )
