"""The joint acceleration v', by the dynamics."""

from __future__ import annotations

import jax

from rbjax.model import Model
from rbjax.sensors.joint_sensors import JointSensor, joint_unit
from rbjax.sensors.protocol import Context
from rbjax.sensors.registry import register


@register("a")
class Accelerations(JointSensor):
    """v' (nv,), by the dynamics."""

    def __call__(self, context: Context) -> jax.Array:
        return context.acceleration

    def unit(self, model: Model) -> str:
        return joint_unit(model, "rad/s^2", "m/s^2")
