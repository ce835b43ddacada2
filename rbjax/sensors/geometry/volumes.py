"""Sensors of the volume of a site: whether a frame is inside, and the touch force.

    insidesite   1 if a point is inside the shape of a site, else 0
    touch        the sum of the normal forces of contacts of the site's body whose line of action,
                 from the point of contact into the body, meets the shape of the site
(MuJoCo, *XML reference*, sensor.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import instance, real_array
from rbjax.errors import InputError, UnknownName
from rbjax.forces.context import Context
from rbjax.lanes import Lane, Vec3
from rbjax.model import Model
from rbjax.model.leaves import frame_transform
from rbjax.sensors.fixed import FrameSensor, named_frame, reading
from rbjax.sensors.geometry.rays import INTERSECTIONS
from rbjax.sensors.protocol import register
from rbjax.sensors.solution import solution_of


class Volume(NamedTuple):
    """The shape of a site.

    kind: "sphere", "capsule", "ellipsoid", "cylinder" or "box".
    size: as of a geom, m.
    """

    kind: str
    size: tuple[float, ...]

    def contains(self, p: Vec3) -> Lane:
        """Return whether a point in the frame of the site is inside."""
        x, y, z = p
        a, b, c = (*self.size, 0.0, 0.0)[:3]
        if self.kind == "sphere":
            return x * x + y * y + z * z <= a * a
        if self.kind == "ellipsoid":
            return (x / a) ** 2 + (y / b) ** 2 + (z / c) ** 2 <= 1
        if self.kind == "box":
            return (jnp.abs(x) <= a) & (jnp.abs(y) <= b) & (jnp.abs(z) <= c)
        if self.kind == "cylinder":
            return (x * x + y * y <= a * a) & (jnp.abs(z) <= b)
        beyond = jnp.maximum(jnp.abs(z) - b, 0.0)
        return x * x + y * y + beyond * beyond <= a * a

    def meets(self, p: Vec3, d: Vec3) -> Lane:
        """Return whether a ray p + s d, s >= 0, in the frame of the site meets the shape."""
        size = Vec3(*(float(x) for x in (*self.size, 0.0, 0.0)[:3]))
        return jnp.isfinite(INTERSECTIONS[self.kind](p, d, size).s)


#: the number of entries of the size of each kind
KINDS = {"sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3}


class VolumeSensor(FrameSensor):
    """Base class of a sensor of the volume of a site.

    frame: the frame of the site; static.
    volume: its shape, which a model does not keep; static.
    """

    labels = ("value",)
    volume: Volume = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        public = "a rbjax.sensors.Volume(kind, size), the shape of the site in its file"
        instance(type(self).__name__, "volume", self.volume, Volume, public)
        if self.volume.kind not in KINDS:
            raise UnknownName("kind of a volume", self.volume.kind, KINDS)
        least = KINDS[self.volume.kind]
        size = real_array(type(self).__name__, "the size of the volume", self.volume.size, ndim=1)
        if not least <= size.size <= 3 or (size < 0).any():
            raise InputError(
                f"{type(self).__name__}: the size of the {self.volume.kind} is {self.volume.size}, "
                f"expected {least} numbers of at least 0 in m, as of a geom"
            )


@register("insidesite", placed=True)
class InsideSite(VolumeSensor):
    """Measure whether the origin of a frame is inside the volume of a site: 1 or 0.

    other: the frame whose origin is tested, as `frame`; static.
    """

    other: Any = eqx.field(static=True, default="world")

    def check(self, model: Model) -> None:
        super().check(model)
        FrameSensor(self.other).check(model)

    def __call__(self, context: Context) -> jax.Array:
        site, other = self.at(context), context.frame(named_frame(context.model, self.other))
        local = site.rotation.T @ (other.position - site.position)
        return reading(context, [jnp.where(self.volume.contains(local), 1.0, 0.0)])


@register("touch", placed=True)
class Touch(VolumeSensor):
    """Measure the sum of the normal forces of contacts in the volume of a site.

    It is zero if the dynamics has no contacts.
    """

    of, clipped = "N", "above"

    def __call__(self, context: Context) -> jax.Array:
        contacts, out = solution_of(context).contacts, jnp.zeros((), context.q.dtype)
        if contacts is None:
            return out[None]
        geoms, site = context.model.geoms, self.at(context)
        assert geoms is not None
        own, _ = frame_transform(context.model, named_frame(context.model, self.frame), float)
        for row, (a, b) in enumerate(contacts.geoms):
            if own not in (geoms.bodies[a], geoms.bodies[b]):
                continue
            inward = -1.0 if own == geoms.bodies[b] else 1.0
            E, normal = site.rotation.T, contacts.force[row, 0]
            p = E @ (contacts.point(row) - site.position)
            felt = contacts.exists[row] & (normal > 0)
            felt &= self.volume.meets(p, E @ (contacts.normal(row) * inward))
            out = out + jnp.where(felt, normal, 0.0)
        return reading(context, [out])
