"""Drag on bodies that turn in a fluid: a torque that grows with the square of the rate."""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax

from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.instant import Instant
from rbjax.lanes import Vec3, mul, neg
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane

#: rad/s below which the drag is smooth
SMOOTH = 1e-6


class RotationalDrag(Element):
    """A torque -c |w| w on bodies, w being their angular velocity in the world.

    Air does that to an arm. It sees the rate of the body, not that of its joint.

    Fields: drag c (n,) N m s^2/rad^2, one number a body. Static: `bodies`, names or indices.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("pendulum")
        >>> air = rb.forces.RotationalDrag(jnp.array([0.25]), model.body_names)
        >>> state = model.default_state().replace(v=jnp.array([2.0]))
        >>> still = rb.applied_forces(model, state)
        >>> (rb.applied_forces(model.with_forces(air), state) - still).round(5).tolist()
        [-1.0]
    """

    drag: jax.Array
    bodies: tuple[str | int, ...] = eqx.field(static=True)

    def may_be_endless(self, name: str) -> bool:
        return False

    def shapes(self, model: Model) -> Shapes:
        return {"drag": (len(self.bodies),)}

    def loads(self, now: Instant) -> Loads:
        column = table(self.drag, now.v.dtype)
        found = Loads()
        for k, body in enumerate(self.bodies):
            frame = now.body(body)
            w = frame.angular_velocity
            size: Any = mul(lane(column, k), w.norm(SMOOTH))
            found = found + frame.push(Vec3.zero(), w * neg(size))
        return found
