"""Candidate contacts of pairs of geoms: their list and their narrow phase."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.geometry.narrow_phase import COUNTS, PAIRS
from rbjax.contact.geometry.shapes import Contact, Shape
from rbjax.lanes import Lane
from rbjax.model.geoms import Geoms
from rbjax.model.hulls import Hull

#: balls are larger by this part, so that rounding errors remove no contact
ROUNDING = 1e-5


class PairKind(NamedTuple):
    """The static data of a pair on which its narrow phase depends. Pairs of one kind share it.

    Fields:
        one, other: the kinds of both geoms, in MuJoCo's order.
        hull: the hull of the other geom if it is a mesh, or None.
        field: the index of the height field of the first geom, or -1.
    """

    one: str
    other: str
    hull: Hull | None = None
    field: int = -1

    @classmethod
    def of(cls, geoms: Geoms, pair: tuple[int, int]) -> PairKind:
        """Return the kind of a pair of geoms."""
        a, b = pair
        hull = geoms.hulls[b] if geoms.hulls and geoms.types[b] == "mesh" else None
        field = geoms.fields[a] if geoms.fields else -1
        return cls(geoms.types[a], geoms.types[b], hull, field)

    @property
    def kinds(self) -> tuple[str, str]:
        """The kinds of both geoms."""
        return self.one, self.other

    @property
    def supported(self) -> bool:
        """Whether there is a narrow phase for the pair."""
        return self.kinds in PAIRS and (self.other != "mesh" or self.hull is not None)


def pairs_of_candidates(geoms: Geoms, pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Return the index of the pair of each candidate, in the order of the narrow phase."""
    counts = [COUNTS[geoms.types[a], geoms.types[b]] for a, b in pairs]
    return [i for i, count in enumerate(counts) for _ in range(count)]


#: pairs whose narrow phase is not much longer than the test whether they are near
SHORT = {("plane", "sphere"), ("plane", "capsule"), ("sphere", "sphere"), ("sphere", "capsule")}


def pair_contacts(
    kind: PairKind, one: Shape, other: Shape, reach: Lane, heights: Sequence[Any] = ()
) -> list[Contact]:
    """Return the candidates of one pair, `COUNTS[kind.kinds]` of them.

    If the shapes are far apart, the narrow phase does not run and no candidate exists.

    Args:
        kind: the kind of the pair.
        one, other: both shapes; the surfaces of meshes and fields are those of `kind`.
        reach: m, the greatest distance of a contact.
        heights: `Geoms.heights`.
    """
    if kind.hull is not None:
        other = other._replace(surface=kind.hull)
    if kind.one == "hfield":
        one = one._replace(surface=heights[kind.field])
    if kind.kinds in SHORT or kind.one == "hfield":
        return PAIRS[kind.kinds](one, other, reach)
    near = jnp.asarray(_near(kind, one, other, reach))
    if near.ndim:  # lanes of several pairs, which cannot branch
        return PAIRS[kind.kinds](one, other, reach)
    dtype = jnp.result_type(*one.p, *other.p)

    def found() -> list[Contact]:
        contacts = PAIRS[kind.kinds](one, other, reach)
        return jax.tree.map(lambda x: jnp.asarray(x, _kept(x, dtype)), contacts)

    none = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(found))
    return jax.lax.cond(near, found, lambda: none)


def _kept(x: Any, dtype: Any) -> Any:
    """Return bool for a boolean, else `dtype`."""
    return bool if jnp.issubdtype(jnp.result_type(x), jnp.bool_) else dtype


def _near(kind: PairKind, one: Shape, other: Shape, reach: Lane) -> Lane:
    """Return whether the balls around both shapes, or the ball and the plane, are within reach."""
    apart, limit = other.p - one.p, _radius(kind.other, kind, other) + reach
    if kind.one == "plane":
        return one.axis.dot(apart) <= limit + ROUNDING * jnp.abs(limit)
    limit = (limit + _radius(kind.one, kind, one)) * (1.0 + ROUNDING)
    return apart.dot(apart) <= limit * jnp.abs(limit)


def _radius(name: str, kind: PairKind, shape: Shape) -> Lane:
    """Return the radius, m, of a ball around a shape. Both have the same center."""
    a, b, c = shape.size
    match name:
        case "sphere":
            return a
        case "capsule":
            return a + b
        case "cylinder":
            return jnp.sqrt(a * a + b * b)
        case "mesh":
            assert kind.hull is not None
            return kind.hull.radius
    return jnp.sqrt(a * a + b * b + c * c)
