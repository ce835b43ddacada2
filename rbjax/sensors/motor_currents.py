"""Motor currents: i = tau / constant."""

from __future__ import annotations

import jax

from rbjax.model import Model
from rbjax.sensors.joint_sensors import JointSensor
from rbjax.sensors.joint_torques import Torques
from rbjax.sensors.protocol import Context


class Currents(JointSensor):
    """Motor currents of the joints: i = tau / constant, in A. constant (nv,) in N m/A at the joint
    can be an unknown: "readings.current.constant"."""

    constant: jax.Array

    def __call__(self, context: Context) -> jax.Array:
        return Torques()(context) / self.constant

    def unit(self, model: Model) -> str:
        return "A"
