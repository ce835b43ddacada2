"""Accelerometers: R^T (p'' - g)."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.dynamics import frame_pose, frame_velocity, integrate
from rbjax.model import Model
from rbjax.sensors.protocol import Context
from rbjax.sensors.registry import register
from rbjax.sensors.site_sensors import SiteSensor


@register("accelerometer", placed=True)
class Accelerometer(SiteSensor):
    """The specific force R^T (p'' - g) (3,) at a site, in its own axes. A sensor at rest measures g
    upwards, one in free fall zero."""

    def __call__(self, context: Context) -> jax.Array:
        model, (q, v) = context.model, (context.state.q, context.state.v)
        a = context.acceleration

        def velocity(s: jax.Array) -> jax.Array:
            at = integrate(model, q, s * v)
            return frame_velocity(model, at, v + s * a, site=self.site)[3:]

        _, rate = jax.jvp(velocity, (jnp.zeros((), q.dtype),), (jnp.ones((), q.dtype),))
        R, _ = frame_pose(model, q, site=self.site)
        return R.T @ (rate - jnp.asarray(model.gravity, q.dtype))

    def unit(self, model: Model) -> str:
        return "m/s^2"
