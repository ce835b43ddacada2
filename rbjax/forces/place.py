"""`Place`: a frame fixed to a body, to a site, or to the world."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.forces.context import Context, FrameState
from rbjax.lanes import Vec3, quaternion_matrix
from rbjax.model import WORLD, Frame
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.model.record import Record, check_fields
from rbjax.rotations import quaternion
from rbjax.spatial import Transform


class Place(Record):
    """A frame fixed to a body, to a site, or to the world if both are None. It is an end of a
    spring, a bushing or a constraint. The axis of a constraint is the z axis of the frame.

    position: (3,) m in the frame of the body or site.
    orientation: (4,) quaternion in the frame of the body or site.
    body, site: name or index; static.

    Where an axis does not matter, an `rb.Frame` is accepted in place of a `Place`.

    Example:
        >>> import rbjax as rb
        >>> rb.forces.Place.on(body="trunk", point=[0.1, 0.0, 0.0], axis=[0, 1, 0]).body
        'trunk'
    """

    position: jax.Array
    orientation: jax.Array
    body: str | int | None = eqx.field(static=True, default=None)
    site: str | int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_fields(self)
        _check_named(self)
        for name, size in (("position", 3), ("orientation", 4)):
            shape = jnp.shape(getattr(self, name))
            if shape[-1:] != (size,):
                raise InputError(f"Place({name}=...): got the shape {shape}, expected ({size},)")

    @classmethod
    def on(
        cls,
        *,
        body: str | int | None = None,
        site: str | int | None = None,
        point: Any = (0.0, 0.0, 0.0),
        axis: Any = (0.0, 0.0, 1.0),
    ) -> Place:
        """Make a frame at a point with z along an axis, both in the frame of the body or site."""
        point = check_array("Place.on", "point", point, (3,)).astype(float)
        axis = check_array("Place.on", "axis", axis, (3,)).astype(float)
        return cls(point, turn_z_to(axis), body, site)

    def frame(self, context: Context) -> FrameState:
        """Return the frame at an instant."""
        quat = table(self.orientation, context.q.dtype)
        turn = quaternion_matrix(*(lane(quat, k) for k in range(4)))
        return _named_frame(self, context).then(Transform(turn, self._position(context)))

    def point(self, context: Context) -> FrameState:
        """Return the frame with the same origin, in the axes of the body or site."""
        return _named_frame(self, context).at(self._position(context))

    def _position(self, context: Context) -> Vec3:
        p = table(self.position, context.q.dtype)
        return Vec3(*(lane(p, k) for k in range(3)))


def _check_named(place: Any) -> None:
    """Raise InputError unless at most one of `body` and `site` of a place is a name or an index."""
    kind = type(place).__name__
    if place.body is not None and place.site is not None:
        raise InputError(
            f"{kind}: got body {place.body!r} and site {place.site!r}; give one of them, or none "
            "for the world"
        )
    for what, name in (("body", place.body), ("site", place.site)):
        if isinstance(name, bool) or not isinstance(name, str | int | None):
            raise InputError(f"{kind}: {what} is {name!r}, expected its name, its index, or None")


def _named_frame(place: Any, context: Context) -> FrameState:
    """Return the frame of the body or site of a place; the world's if both are None."""
    if place.site is not None:
        return context.site(place.site)
    return context.body(WORLD if place.body is None else place.body)


def as_place(given: Any) -> Any:
    """Convert an `rb.Frame` to a place, as a field's converter. Return anything else unchanged."""
    if not isinstance(given, Frame):
        return given
    if given.geom is not None or given.center is not None:
        raise InputError(
            f"{given}: got a geom or a center of mass, expected a body or a site; give "
            "rb.Frame(body=..., point=...)"
        )
    body, site = given.body, given.site
    if (body is None) == (site is None):
        got = "neither" if body is None else "both"
        raise InputError(f"Frame: got {got} of body and site, expected exactly one")
    point = (0.0, 0.0, 0.0) if given.point is None else given.point
    place = Place.on(body=None if body == "world" else body, site=site, point=point)
    if given.orientation is None:
        return place
    turn = check_array("FrameState", "orientation", given.orientation, (4,)).astype(float)
    return Place(place.position, quaternion.normalize(turn), place.body, site)


def check_places(record: Any) -> None:
    """Raise InputError if the ends a and b of an element or a constraint are not places."""
    for end in ("a", "b"):
        got = getattr(record, end)
        known = "Place.on(body=...), on(site=...) or on() for the world"
        public = f"a Place or an rb.Frame: rbjax.forces.{known}"
        instance(type(record).__name__, end, got, Place, public)


def turn_z_to(axis: jax.Array) -> jax.Array:
    """Compute the quaternion (4,) of a rotation from z to the direction of an axis (3,).

    If the z coordinate of the axis is not negative, it is the shortest rotation. Otherwise it is a
    half turn about x, followed by the shortest rotation from -z to the axis.
    """
    length = jnp.sqrt((axis * axis).sum())
    if not isinstance(length, jax.core.Tracer) and not np.asarray(length) > 0:
        raise InputError(f"an axis is {np.asarray(axis).tolist()}, expected a direction")
    x, y, z = axis / length
    down = z < 0  # after a half turn about x, -z is rotated to the axis
    side = jnp.where(down, -1.0, 1.0)
    q = jnp.stack([1.0 + jnp.abs(z), -side * y, side * x, jnp.zeros_like(x)])
    half_turn = jnp.array([0.0, 1.0, 0.0, 0.0], q.dtype)
    return quaternion.normalize(jnp.where(down, quaternion.multiply(q, half_turn), q))
