"""The vertical forces of the floor on two feet, from the acceleration of the robot.

No actuator acts on a floating base, so the first six inverse dynamics are the wrench of the floor,

    (f, n) = M a + b,     n about the origin of the base
About a point p of a flat floor its center of pressure is c = p + (-n_y, n_x) / f_z, with n about p.
Two feet carry f_z in the ratio of the lever arms of c along the line between their sites. It is
exact if the force of each foot acts below its site. If one foot touches, it carries all. The
contact problem is not solved again.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import instance, real_number
from rbjax.dynamics.algorithms.rnea import inverse_dynamics
from rbjax.envs.terms.feet import Feet
from rbjax.envs.terms.frames import Term, frame_at
from rbjax.envs.terms.touch import touching_at
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.lanes import Vec3
from rbjax.sensors.solution import solution_of


def two_foot_loads(context: Context, feet: Feet, floor: float = 0.0) -> jax.Array:
    """Compute the vertical forces of the floor on two feet, at the last physics step.

    Args:
        context: `Transition.after`.
        feet: the two feet of the robot.
        floor: height of the floor, m.

    Returns:
        (2,), N.

    Raises:
        InputError: a robot without a free joint as its first joint, or another number of feet.

    Example:
        >>> import rbjax as rb
        >>> terms = rb.envs.terms
        >>> feet = terms.Feet(("left", "right"), (("left", "floor"), ("right", "floor")))
        >>> loads = lambda transition: terms.two_foot_loads(transition.after, feet)
        >>> rb.envs.Observation("loads", loads, noise=5.0).noise
        5.0
    """
    model = context.model
    if len(feet.sites) != 2 or model.topology.joint_kinds[:1] != ("free",):
        raise InputError(
            f"two_foot_loads: {len(feet.sites)} feet on a robot whose first joint is "
            f"{model.topology.joint_kinds[:1]}, expected 2 feet and a free joint"
        )
    a = solution_of(context).acceleration
    base = inverse_dynamics(model, context.q, context.v, a)
    force = Vec3(*(base[k] for k in range(3)))
    root = context.link(model.topology.body_links[0])
    moment = root.rotation @ Vec3(*(base[k] for k in range(3, 6)))
    left, right = (frame_at(context, s).position for s in feet.sites)
    arm = root.position - Vec3(left[0], left[1], floor)  # to below the first foot
    moment = moment + arm.cross(force)
    span = right - left
    square = span[0] * span[0] + span[1] * span[1]
    # f_z (c - left) . span, with f_z c = (-n_y, n_x)
    share = span[1] * moment[0] - span[0] * moment[1]
    fz = jnp.maximum(force[2], 0.0)
    second = jnp.clip(share / jnp.maximum(square, 1e-6), 0.0, fz)
    one, other = touching_at(context, feet.pairs)
    second = jnp.where(one & other, second, jnp.where(other, fz, 0.0))
    return jnp.where(one | other, jnp.stack([fz - second, second]), 0.0)


def excess_load(feet: Feet, most: float, floor: float = 0.0) -> Term:
    """Return the term: the sum of max(f - most, 0) of the vertical forces f on two feet.

    Args:
        feet: the two feet of the robot.
        most: force without a cost, N.
        floor: height of the floor, m.

    Returns:
        Function of a `Transition` that returns (), N.

    Raises:
        InputError: not `Feet`, or loads that are not finite numbers.

    Example:
        >>> import rbjax as rb
        >>> terms = rb.envs.terms
        >>> feet = terms.Feet(("left", "right"), (("left", "floor"), ("right", "floor")))
        >>> rb.envs.Reward("impact", terms.excess_load(feet, 500.0), -0.01).weight
        -0.01
    """
    instance("excess_load", "feet", feet, Feet, "rb.envs.terms.Feet")
    real_number("excess_load", "most", most)
    real_number("excess_load", "floor", floor)

    def read(transition: Any) -> jax.Array:
        return jnp.maximum(two_foot_loads(transition.after, feet, floor) - most, 0.0).sum()

    return read
