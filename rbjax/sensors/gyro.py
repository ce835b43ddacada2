"""Gyroscopes: gyro = R^T w."""

from __future__ import annotations

import jax

from rbjax.dynamics import frame_pose, frame_velocity
from rbjax.model import Model
from rbjax.sensors.protocol import Context
from rbjax.sensors.registry import register
from rbjax.sensors.site_sensors import SiteSensor


@register("gyro", placed=True)
class Gyro(SiteSensor):
    """The angular velocity R^T w (3,) of a site, in its own axes."""

    def __call__(self, context: Context) -> jax.Array:
        model, state = context.model, context.state
        R, _ = frame_pose(model, state.q, site=self.site)
        return R.T @ frame_velocity(model, state.q, state.v, site=self.site)[:3]

    def unit(self, model: Model) -> str:
        return "rad/s"
