"""Where a constraint takes hold: a frame fixed to a body, to a site, or to the world."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance
from rbjax.dynamics.algorithms.kinematics import forward_kinematics
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError
from rbjax.forces.anchor import check_named, named_frame
from rbjax.forces.instant import Frame, Instant
from rbjax.lanes import Vec3, quaternion_matrix
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.model.record import Record, check_fields
from rbjax.rotations import quaternion
from rbjax.spatial import Transform


class Place(Record):
    """A frame fixed to a body, to a site, or to the world if neither is named; its z is the axis of
    a joint that has one.

    Fields: position (3,) m and orientation (4,), a quaternion, in the frame of the body or site.
    Static: `body`, `site`, its name or index.

    Example:
        >>> import rbjax as rb
        >>> rb.constraints.Place.on(body="trunk", point=[0.1, 0.0, 0.0], axis=[0, 1, 0]).body
        'trunk'
    """

    position: jax.Array
    orientation: jax.Array
    body: str | int | None = eqx.field(static=True, default=None)
    site: str | int | None = eqx.field(static=True, default=None)

    def __check_init__(self) -> None:
        check_fields(self)
        check_named(self)
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
        """The frame at a point, its z along an axis; both in the frame of the body or site."""
        point = check_array("Place.on", "point", point, (3,)).astype(float)
        axis = check_array("Place.on", "axis", axis, (3,)).astype(float)
        return cls(point, turn_z_to(axis), body, site)

    def frame(self, now: Instant) -> Frame:
        """The frame at an instant."""
        p, quat = (table(x, now.q.dtype) for x in (self.position, self.orientation))
        turn = quaternion_matrix(*(lane(quat, k) for k in range(4)))
        return named_frame(self, now).then(Transform(turn, Vec3(*(lane(p, k) for k in range(3)))))


def check_places(constraint: Any) -> None:
    """Refuse ends a and b of a constraint that are no places."""
    for end in ("a", "b"):
        got = getattr(constraint, end)
        if not isinstance(got, Place):
            raise InputError(
                f"{type(constraint).__name__}: {end} is {type(got).__name__}, expected a Place: "
                "rbjax.constraints.Place.on(body=...), on(site=...) or on() for the world"
            )


def turn_z_to(axis: jax.Array) -> jax.Array:
    """The quaternion (4,) of a rotation that takes z to an axis (3,) of any length.

    If the axis's z is not negative, it is the shortest rotation. Otherwise it is a half turn about
    x, followed by the shortest rotation of -z to the axis.
    """
    length = jnp.sqrt((axis * axis).sum())
    if not isinstance(length, jax.core.Tracer) and not np.asarray(length) > 0:
        raise InputError(f"an axis is {np.asarray(axis).tolist()}, expected a direction")
    x, y, z = axis / length
    down = z < 0  # then -z is turned to it, after a half turn about x
    side = jnp.where(down, -1.0, 1.0)
    q = jnp.stack([1.0 + jnp.abs(z), -side * y, side * x, jnp.zeros_like(x)])
    half_turn = jnp.array([0.0, 1.0, 0.0, 0.0], q.dtype)
    return quaternion.normalize(jnp.where(down, quaternion.multiply(q, half_turn), q))


def places(
    model: Model,
    a: str | int | None,
    b: str | int | None,
    *,
    point: Any = (0.0, 0.0, 0.0),
    axis: Any = (0.0, 0.0, 1.0),
    q: jax.Array | None = None,
) -> tuple[Place, Place]:
    """One frame, fixed to two bodies (or the world, None) as they are in a configuration.

    Args:
        model: the robot.
        a, b: names or indices of bodies.
        point: (3,) m in the world.
        axis: (3,), of any length, in the world.
        q: (nq,); the model's default state if None.
    """
    instance("between", "model", model, Model, "the Model that the joint is for (rbjax.load)")
    q = model.default_state().q if q is None else q
    point = check_array("places", "point", point, (3,)).astype(q.dtype)
    turn = turn_z_to(check_array("places", "axis", axis, (3,)).astype(q.dtype))
    R, p = forward_kinematics(model, q)

    def of(body: str | int | None) -> Place:
        if body is None:
            return Place(point, turn)
        k = model.body(body)
        own = quaternion.conjugate(quaternion.from_matrix(R[k]))
        return Place(R[k].T @ (point - p[k]), quaternion.multiply(own, turn), body)

    return of(a), of(b)
