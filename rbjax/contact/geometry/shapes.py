"""Primitive shapes, candidate contacts and their frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import Lane, Mat3, Vec3
from rbjax.lanes.arrays import select
from rbjax.model import Model
from rbjax.model.leaves import geom_transform, table
from rbjax.model.links import lane
from rbjax.spatial import Transform

#: a length that counts as zero, m
TINY = 1e-15
#: two directions are parallel if the squared sine of the angle between them is smaller
PARALLEL = 1e-8


class Shape(NamedTuple):
    """A primitive in the world.

    Fields:
        p: position of the center, m; of a plane, a point of it.
        R: rotation from the axes of the shape to world axes. Axis z is the axis of a capsule or
            cylinder and the normal of a plane.
        size: as `Geoms.size`, m.
        surface: the `Hull` of a mesh, or the heights (rows, columns) of a height field, m.
    """

    p: Vec3
    R: Mat3
    size: Vec3
    surface: Any = None

    @property
    def axis(self) -> Vec3:
        """Axis z in the world."""
        return self.R.columns[2]


def geom_shape(model: Model, geom: int, body: Transform, dtype: Any) -> Shape:
    """Place a geom in the frame in which the pose of its body is given."""
    assert model.geoms is not None
    pose, size = body.then(geom_transform(model, geom, dtype)), table(model.geoms.size, dtype)
    return Shape(pose.p, pose.R, Vec3(*(lane(size[:, k], geom) for k in range(3))))


def stack_shapes(shapes: Sequence[Shape], dtype: Any) -> Shape:
    """Stack n shapes without surfaces to one shape of lanes (n,)."""
    return jax.tree.map(lambda *x: jnp.stack([jnp.asarray(lane, dtype) for lane in x]), *shapes)


class Contact(NamedTuple):
    """A candidate contact.

    Fields:
        distance: between the surfaces, m.
        position: the midpoint between the surfaces, m.
        normal: unit vector from the first shape to the second.
        exists: whether the distance is at most the reach and the candidate is one of the contacts.
        tangent: a direction near which the first tangent of the contact frame is chosen, or None.
    """

    distance: Lane
    position: Vec3
    normal: Vec3
    exists: Lane
    tangent: Vec3 | None = None

    @property
    def lanes(self) -> list[Lane]:
        """Distance, position, normal and tangent, zero for none: 10 lanes."""
        tangent = Vec3.zero() if self.tangent is None else self.tangent
        return [self.distance, *self.position, *self.normal, *tangent]


def contact_frame(normal: Vec3, tangent: Vec3 | None = None) -> tuple[Vec3, Vec3, Vec3]:
    """Return the axes of a contact frame: the normal and two tangents.

    The first tangent is the direction `tangent` made orthogonal to the normal. If there is none, or
    if it is parallel to the normal, it is world axis y, or world axis z if the normal is within 60
    degrees of y.
    """
    steep = jnp.abs(normal[1]) >= 0.5
    first = Vec3(0.0, jnp.where(steep, 0.0, 1.0), jnp.where(steep, 1.0, 0.0))
    if tangent is not None:
        across = tangent - normal * normal.dot(tangent)
        first = select(across.dot(across) > PARALLEL * tangent.dot(tangent), tangent, first)
    first = unit(first - normal * normal.dot(first), Vec3(1.0, 0.0, 0.0))
    return normal, first, normal.cross(first)


def unit(v: Vec3, otherwise: Vec3) -> Vec3:
    """Return v / |v|, or `otherwise` if v is zero. The derivatives are finite."""
    square = v.dot(v)
    valid = square > TINY * TINY
    return select(valid, v * (1 / jnp.sqrt(jnp.where(valid, square, 1.0))), otherwise)
