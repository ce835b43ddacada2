"""Joint encoders: the configuration q."""

from __future__ import annotations

import jax

from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.sensors.columns import Columns
from rbjax.sensors.joint_sensors import joint_columns, joint_unit
from rbjax.sensors.protocol import Context
from rbjax.sensors.registry import register


@register("q")
class Positions(Record):
    """q (nq,), attitudes as quaternions."""

    def __call__(self, context: Context) -> jax.Array:
        return context.state.q

    def columns(self, model: Model) -> Columns:
        return Columns.of_positions(model)

    def names(self, model: Model) -> tuple[str, ...]:
        """The joint of each value, with an index if the joint has several."""
        return joint_columns(model, velocity=False)

    def unit(self, model: Model) -> str:
        return joint_unit(model, "rad", "m")
