"""Joint tachometers: the velocity v."""

from __future__ import annotations

import jax

from rbjax.model import Model
from rbjax.sensors.joint_sensors import JointSensor, joint_unit
from rbjax.sensors.protocol import Context
from rbjax.sensors.registry import register


@register("v")
class Velocities(JointSensor):
    """v (nv,)."""

    def __call__(self, context: Context) -> jax.Array:
        return context.state.v

    def unit(self, model: Model) -> str:
        return joint_unit(model, "rad/s", "m/s")
