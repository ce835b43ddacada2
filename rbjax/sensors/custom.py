"""A user's function as a sensor."""

from __future__ import annotations

from collections.abc import Callable

import equinox as eqx
import jax

from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.sensors.columns import Columns
from rbjax.sensors.protocol import Context


class CustomSensor(Record):
    """A function of a `Context` as a sensor.

    Args:
        function: (context) -> (size,), traced.
        size: the number of values.
        of: their SI unit, for messages.

    Example:
        >>> import rbjax as rb
        >>> height = rb.sensors.CustomSensor(lambda context: context.state.q[2:3], 1, "m")
        >>> setup = rb.sysid.Setup.of(rb.load("free_body")).with_sensors({"other:height": height})
        >>> sorted(setup.sensors)
        ['other:height', 'q', 'v']
    """

    function: Callable[[Context], jax.Array] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    of: str = eqx.field(static=True, default="")

    def __call__(self, context: Context) -> jax.Array:
        return self.function(context)

    def columns(self, model: Model) -> Columns:
        return Columns(self.size)

    def unit(self, model: Model) -> str:
        return self.of
