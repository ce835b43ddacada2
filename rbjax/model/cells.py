"""Link constants entry by entry, if some leaves of a model are constant and others are traced.

A cell is a lane in a numpy object array. On arrays of cells the array code of `prepare` computes
each entry separately: products with a constant zero vanish, and all other products are traced.
`Model.fix_zeros` makes entries of leaves constant.
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
    """A lane as an entry of a numpy object array."""

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
    """Return the lane in a cell, or a number as a literal (a Python float)."""
    return x.lane if isinstance(x, Cell) else float(x)


def literals(x: Any, *, units: bool) -> tuple[float | None, ...]:
    """Return the pattern of an array: the constant 0 (with `units`, also 1 and -1) or None.

    The pattern has one value for each entry, in row-major order.
    """
    known = (0.0, 1.0, -1.0) if units else (0.0,)
    lanes = map(lane_of, np.asarray(x).ravel())
    return tuple(v if is_literal(v) and v in known else None for v in lanes)


def with_pattern(x: Any, pattern: tuple[float | None, ...]) -> Any:
    """Replace the entries of an array for which a pattern (`literals`) has a value."""
    xp = jnp if isinstance(x, jax.core.Tracer) else np
    values = np.array([np.nan if v is None else v for v in pattern], x.dtype).reshape(x.shape)
    return xp.where(np.isnan(values), x, values)


def cells(x: Any, pattern: tuple[float | None, ...], known: bool) -> np.ndarray:
    """Convert an array to an object array of literals and cells.

    An entry is a literal if the array is constant (`known`) or the pattern has a value for it.
    """
    if known:
        return with_pattern(np.asarray(x, np.float64), pattern).astype(object)
    out = np.empty(len(pattern), object)
    flat = x.reshape(-1)
    for i, value in enumerate(pattern):
        out[i] = Cell(flat[i]) if value is None else value
    return out.reshape(x.shape)


def cast_cells(x: np.ndarray, dtype: Any) -> np.ndarray:
    """Convert the traced entries of an object array of cells to a dtype."""
    out = [Cell(c.lane.astype(dtype)) if isinstance(c, Cell) and not is_literal(c.lane) else c
           for c in x.ravel()]  # fmt: skip
    return np.fromiter(out, object, len(out)).reshape(x.shape)


@jax.tree_util.register_pytree_node_class
class Sparse:
    """A column as a pytree: its zeros (and ones) are static, all other entries are one leaf."""

    def __init__(self, pattern: tuple[float | None, ...], others: Any):
        self.pattern, self.others = pattern, others

    @classmethod
    def of(cls, column: Any, dtype: Any, *, units: bool = False) -> Sparse:
        """Make a `Sparse` from a column of numbers or cells, or from a traced array.

        units: whether ones and minus ones are static too.
        """
        if isinstance(column, jax.Array):
            return cls((None,) * column.shape[0], column.astype(dtype))
        pattern = literals(column, units=units)
        others = [lane_of(x) for x, known in zip(column, pattern, strict=True) if known is None]
        if all(map(is_literal, others)):
            return cls(pattern, np.array(others, dtype))
        return cls(pattern, jnp.stack([jnp.asarray(x, dtype) for x in others]))

    def column(self) -> Any:
        """Return the column: literals and cells, or an array if no entry is static."""
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
    """Convert an array of numbers or of cells (`Cell`) to a JAX array of the dtype."""
    if x.dtype != object:
        return jnp.asarray(x, dtype)
    rows = [jnp.asarray(lane_of(v), dtype) for v in x.ravel()]
    return jnp.stack(rows).reshape(x.shape) if rows else jnp.zeros(x.shape, dtype)


def all_literal(row: Any) -> bool:
    """Return True if every entry is a constant."""
    return all(is_literal(lane_of(v)) for v in row)


#: the leaves of bodies and joints that, with gravity, determine the link constants
_CONSTANTS = (
    "mass", "com", "inertia", "position", "orientation",
    "placement", "axis", "reference", "armature", "params",
)  # fmt: skip


def constant_leaves(model: Any) -> dict[str, Any]:
    """Return the leaves that determine the link constants, by name."""
    leaves = _fields(model.bodies) | _fields(model.joints)
    return {name: leaves[name] for name in _CONSTANTS} | {"gravity": model.gravity}


def with_fixed_entries(changes: dict[str, Any], zeros: dict[str, tuple]) -> dict[str, Any]:
    """Restore the entries of changed leaves that `Model.fix_zeros` has fixed."""

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
    """Return the name and the pattern (`literals`) of each leaf that determines link constants.

    Patterns of axes and orientations contain 0, 1 and -1, all others only 0.
    """
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
