"""Joint torque sensors: the generalized forces of the actuators."""

from __future__ import annotations

import jax

from rbjax.forces.acting import applied_forces
from rbjax.model import Model
from rbjax.sensors.joint_sensors import JointSensor, joint_unit
from rbjax.sensors.protocol import Context
from rbjax.sensors.registry import register


@register("tau")
class Torques(JointSensor):
    """The generalized forces (nv,) of actuators and of force elements that take controls:
    tau = moment^T f(u, l, l'). Springs, dampers and friction do not count."""

    def __call__(self, context: Context) -> jax.Array:
        model, state, t = context.model, context.state, context.t
        return applied_forces(model, state, context.ctrl, t) - applied_forces(model, state, None, t)

    def unit(self, model: Model) -> str:
        return joint_unit(model, "N m", "N")
