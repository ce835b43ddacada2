"""Motion capture of a marker: the position of a site."""

from __future__ import annotations

import jax

from rbjax.dynamics import frame_pose
from rbjax.model import Model
from rbjax.sensors.protocol import Context
from rbjax.sensors.registry import register
from rbjax.sensors.site_sensors import SiteSensor


@register("position", placed=True)
class Position(SiteSensor):
    """p (3,) of a site in the world."""

    def __call__(self, context: Context) -> jax.Array:
        return frame_pose(context.model, context.state.q, site=self.site)[1]

    def unit(self, model: Model) -> str:
        return "m"
