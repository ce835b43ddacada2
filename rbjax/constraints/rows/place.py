"""One frame fixed to two bodies: the ends of a joint that is a constraint."""

from __future__ import annotations

from typing import Any

import jax

from rbjax.arguments import instance
from rbjax.dynamics.algorithms.kinematics import forward_kinematics
from rbjax.dynamics.arguments import check_array
from rbjax.forces.place import Place, turn_z_to
from rbjax.model import Model
from rbjax.rotations import quaternion


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
