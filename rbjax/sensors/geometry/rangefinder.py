"""The rangefinder: the distance along a ray to the nearest geom."""

from __future__ import annotations

from itertools import repeat
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.contact.geometry.shapes import geom_shape, stack_shapes
from rbjax.forces.context import Context
from rbjax.lanes import Vec3
from rbjax.lanes.arrays import select, smallest
from rbjax.model import Model
from rbjax.model.leaves import frame_transform
from rbjax.sensors.columns import Columns
from rbjax.sensors.fixed import AXES, FrameSensor, check_data, named_frame, reading
from rbjax.sensors.geometry.rays import INTERSECTIONS
from rbjax.sensors.protocol import register

#: data of a rangefinder -> names of its values, in MuJoCo's order
DATA = {
    "dist": ("dist",),
    "dir": tuple(f"dir_{x}" for x in AXES),
    "origin": tuple(f"origin_{x}" for x in AXES),
    "point": tuple(f"point_{x}" for x in AXES),
    "normal": tuple(f"normal_{x}" for x in AXES),
    "depth": ("depth",),
}


class Ray(NamedTuple):
    """The nearest hit of a ray: its distance, infinite for none, and the normal of the surface."""

    distance: jax.Array
    normal: Vec3


@register("rangefinder", placed=True)
class Rangefinder(FrameSensor):
    """Measure the distance from a frame along its z axis to the nearest geom; -1 if there is none.

    Geoms of the body of the frame, invisible geoms, and geoms other than primitives are not seen.
    data: values to return, of `DATA`: "dist", "dir", "origin", "point", "normal", "depth"; static.
    """

    of = "m"
    data: tuple[str, ...] = eqx.field(static=True, default=("dist",))

    def __check_init__(self) -> None:
        check_data("Rangefinder", "data of a rangefinder", self.data, DATA)

    def columns(self, model: Model) -> Columns:
        self.check(model)
        return Columns(len(self.names(model)))

    def names(self, model: Model) -> tuple[str, ...]:
        return tuple(name for part in self.data for name in DATA[part])

    def __call__(self, context: Context) -> jax.Array:
        model, frame = context.model, self.at(context)
        own, _ = frame_transform(model, named_frame(model, self.frame), float)
        origin, along = frame.position, frame.rotation.columns[2]
        hit = cast_ray(context, origin, along, seen_geoms(model, own))
        some = jnp.isfinite(hit.distance)
        distance = jnp.where(some, hit.distance, -1.0)
        reached = origin + along * jnp.where(some, distance, 0.0)
        none = Vec3.zero()
        parts: dict[str, Any] = {
            "dist": [distance],
            "dir": select(some, along, none),
            "origin": origin,
            "point": select(some, reached, none),
            "normal": select(some, hit.normal, none),
            "depth": [distance],
        }
        return reading(context, [x for part in self.data for x in parts[part]])


def seen_geoms(model: Model, own: int) -> list[int]:
    """Return the geoms that a ray from a body sees: visible primitives of other bodies."""
    geoms = model.geoms
    if geoms is None:
        return []
    rows = zip(geoms.types, geoms.bodies, geoms.rgba, strict=True)
    return [
        i for i, (kind, body, rgba) in enumerate(rows)
        if kind in INTERSECTIONS and body != own and rgba[3] != 0
    ]  # fmt: skip


def cast_ray(context: Context, origin: Vec3, along: Vec3, geoms: list[int]) -> Ray:
    """Return the nearest intersection of a ray with geoms, evaluated kind by kind."""
    own, dtype = context.model.geoms, context.q.dtype
    far = jnp.full((), jnp.inf, dtype)
    best = Ray(far, Vec3.zero())
    if own is None:
        return best
    for kind, intersection in INTERSECTIONS.items():
        members = [i for i in geoms if own.types[i] == kind]
        if not members:
            continue
        bodies = [context.body(own.bodies[i]).pose for i in members]
        placed = map(geom_shape, repeat(context.model), members, bodies, repeat(dtype))
        shape = stack_shapes(list(placed), dtype)
        E = shape.R.T
        s, normal = intersection(E @ (origin - shape.p), E @ along, shape.size)
        first, at = smallest(s), jnp.argmin(s)
        outward = [jnp.broadcast_to(x, s.shape)[at] for x in shape.R @ normal]
        closer = first < best.distance
        best = Ray(
            jnp.where(closer, first, best.distance), select(closer, Vec3(*outward), best.normal)
        )
    return best
