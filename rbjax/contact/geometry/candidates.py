"""Candidate contacts of pairs of geoms: their list, their narrow phase, and a bound of distance."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax.numpy as jnp

from rbjax.contact.geometry.narrow_phase import COUNTS, PAIRS
from rbjax.contact.geometry.shapes import TINY, Contact, Shape
from rbjax.lanes import Lane
from rbjax.model.geoms import Geoms
from rbjax.model.hulls import Hull


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


class Candidate(NamedTuple):
    """A candidate contact.

    Fields:
        pair: index of its pair of geoms.
        slot: which of the candidates of the pair.
        bodies: the bodies of both geoms, -1 for the world.
    """

    pair: int
    slot: int
    bodies: tuple[int, int]


def candidates(geoms: Geoms, pairs: Sequence[tuple[int, int]]) -> tuple[Candidate, ...]:
    """Return all candidate contacts of pairs of geoms, in the order of the narrow phase."""
    return tuple(
        Candidate(i, k, (geoms.bodies[a], geoms.bodies[b]))
        for i, (a, b) in enumerate(pairs)
        for k in range(COUNTS[geoms.types[a], geoms.types[b]])
    )


def pair_contacts(
    kind: PairKind, one: Shape, other: Shape, reach: Lane, heights: Sequence[Any] = ()
) -> list[Contact]:
    """Return the candidates of one pair, `COUNTS[kind.kinds]` of them.

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
    return PAIRS[kind.kinds](one, other, reach)


def cheap_distance(kind: PairKind, one: Shape, other: Shape) -> Lane:
    """Return a lower bound of the distance of two shapes, m, from spheres around them.

    Use it to skip pairs that are far apart. The bound of a plane is its distance to the sphere. The
    bound of a height field is the way to its rectangle, or none above and below it.
    """
    radius = _radius(kind.other, other, kind.hull)
    if kind.one == "plane":
        return one.axis.dot(other.p - one.p) - radius
    if kind.one == "hfield":
        c = one.R.T @ (other.p - one.p)
        beyond = jnp.maximum(jnp.abs(c[0]) - one.size[0], jnp.abs(c[1]) - one.size[1])
        return jnp.where(beyond > radius, beyond - radius, -jnp.inf)
    d = other.p - one.p
    return d.norm(TINY) - _radius(kind.one, one) - radius


def _radius(kind: str, shape: Shape, hull: Hull | None = None) -> Lane:
    """Return the radius of a sphere around the origin of a shape that contains the shape."""
    x, y, z = shape.size
    if hull is not None:
        return hull.radius
    if kind == "sphere":
        return x
    if kind == "capsule":
        return x + y
    if kind == "cylinder":
        return jnp.sqrt(x * x + y * y)
    if kind == "ellipsoid":
        return jnp.maximum(jnp.maximum(x, y), z)
    return jnp.sqrt(x * x + y * y + z * z)
