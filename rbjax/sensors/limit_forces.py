"""Sensors of the forces of limits of joints and tendons.

The force of a row of the contact problem, if the dynamics is soft contact, plus the forces of
`rbjax.forces.JointLimits`.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.contact.rows.scalar_row import LIMIT
from rbjax.forces.context import Context
from rbjax.forces.joint_state import JointState
from rbjax.forces.joints.limits import JointLimits
from rbjax.lanes import Lane, inner, safe_sqrt
from rbjax.sensors.actuators import TendonLimitSensor
from rbjax.sensors.fixed import reading
from rbjax.sensors.joints import JointLimitSensor
from rbjax.sensors.protocol import register
from rbjax.sensors.solution import solution_of


@register("jointlimitfrc", placed=True)
class JointLimitForce(JointLimitSensor):
    """Measure the force of a joint limit, which is not negative.

    It is the force of the contact solver and of `rbjax.forces.JointLimits`; zero without both.
    """

    units, clipped = ("N m", "N"), "above"

    def __call__(self, context: Context) -> jax.Array:
        joint = context.joint(self.joint)
        total = [sum_of(context, joint, k) for k in range(len(joint.v))]
        force = safe_sqrt(inner(total, total))
        solved = _force_of_rows(context, "joint", context.model.joint(self.joint))
        return reading(context, [force + solved])


@register("tendonlimitfrc", placed=True)
class TendonLimitForce(TendonLimitSensor):
    """Measure the force of a tendon limit of the contact solver, which is not negative; zero if
    the dynamics is not a contact law."""

    of, clipped = "N", "above"

    def __call__(self, context: Context) -> jax.Array:
        own = context.model.tendon(self.tendon)
        return reading(context, [_force_of_rows(context, "tendon", own)])


def _force_of_rows(context: Context, part: str, index: int) -> Lane:
    """Return the force of the limit of a joint or tendon from the contact solver; zero without
    contacts."""
    solved = solution_of(context).solved
    return 0.0 if solved is None else solved.force_of(LIMIT, part, index)


def sum_of(context: Context, joint: JointState, k: int) -> Lane:
    """Return the generalized force of all `JointLimits` on dof k of a joint."""

    def compute() -> dict[int, Lane]:
        limits = [x for x in context.model.forces if isinstance(x, JointLimits)]
        out: dict[int, Lane] = {}
        for element in limits:
            for i, x in element.loads(context).tau.items():
                out[i] = out[i] + x if i in out else x
        return out

    zero = jnp.zeros((), context.q.dtype)
    return context.once(sum_of, compute).get(joint.start + k, zero)
