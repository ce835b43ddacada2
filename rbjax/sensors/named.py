"""A sensor of a model: its name, its cutoff and its noise."""

from __future__ import annotations

import sys
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.errors import InputError, UnknownName
from rbjax.forces.context import Context
from rbjax.model import Model
from rbjax.model.record import Record
from rbjax.sensors.columns import Columns
from rbjax.sensors.protocol import register


class NamedSensor(Record):
    """An entry of `model.sensors`: an ideal sensor with a name.

    name: name, which `rb.sense(..., named=True)` and `Setup.with_sensors` use; static.
    sensor: the ideal sensor.
    cutoff: largest absolute value of a reading, or 0 for none; static.
    noise: standard deviation of the noise of a reading, which `rb.sense` does not add; static.

    Example:
        >>> import rbjax as rb
        >>> gyro = rb.sensors.NamedSensor("imu", rb.sensors.Gyro("tool"), noise=0.01)
        >>> arm = rb.load("arm7").replace(sensors=(gyro,))
        >>> rb.sense(arm, arm.default_state()).shape
        (3,)
    """

    name: str = eqx.field(static=True)
    sensor: Any
    cutoff: float = eqx.field(static=True, default=0.0)
    noise: float = eqx.field(static=True, default=0.0)

    def __check_init__(self) -> None:
        where = "NamedSensor"
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"{where}: name is {self.name!r}, expected a word")
        if isinstance(self.sensor, type) or not callable(getattr(self.sensor, "columns", None)):
            raise InputError(
                f"{where}: sensor is {self.sensor!r}, expected a sensor such as "
                'rbjax.sensors.Gyro("imu")'
            )
        for field in ("cutoff", "noise"):
            x = getattr(self, field)
            known = isinstance(x, int | float) and not isinstance(x, bool)
            if not known or not 0 <= x <= sys.float_info.max:
                raise InputError(f"{where}: {field} is {x!r}, expected a number of at least 0")

    def __call__(self, context: Context) -> jax.Array:
        due = (self.columns(context.model).size,)  # it names what the model does not have
        values = self.sensor(context)
        if jnp.shape(values) != due:
            raise InputError(
                f"sensor {self.name!r}: the reading has shape {jnp.shape(values)}, expected {due}, "
                f"the size of {type(self.sensor).__name__}"
            )
        clipped = getattr(self.sensor, "clipped", "both")
        if not self.cutoff or not clipped:
            return values
        values = jnp.minimum(values, self.cutoff)
        return jnp.maximum(values, -self.cutoff) if clipped == "both" else values

    def columns(self, model: Model) -> Columns:
        return self.sensor.columns(model)

    def names(self, model: Model) -> tuple[str, ...]:
        """List the names of the values."""
        names = getattr(self.sensor, "names", None)
        return tuple(map(str, range(self.columns(model).size))) if names is None else names(model)

    def unit(self, model: Model) -> str:
        return self.sensor.unit(model)


@register("sensor", placed=True)
class ModelSensor(Record):
    """Measure what a sensor of the model measures, `model.sensors`, given by its name; static.

    It makes the sensors of a file available by name in recordings and in identification.

    Example:
        >>> import rbjax as rb
        >>> imu = rb.sensors.NamedSensor("imu", rb.sensors.Gyro("tool"))
        >>> arm = rb.load("arm7").replace(sensors=(imu,))
        >>> rb.sysid.Setup.of(arm).with_sensors("sensor:imu").unit("sensor:imu")
        'rad/s'
    """

    name: str = eqx.field(static=True)

    def __call__(self, context: Context) -> jax.Array:
        return self._of(context.model)(context)

    def columns(self, model: Model) -> Columns:
        return self._of(model).columns(model)

    def names(self, model: Model) -> tuple[str, ...]:
        """List the names of the values."""
        return self._of(model).names(model)

    def unit(self, model: Model) -> str:
        return self._of(model).unit(model)

    def _of(self, model: Model) -> NamedSensor:
        for sensor in model.sensors:
            if sensor.name == self.name:
                return sensor
        raise UnknownName("sensor of the model", self.name, [x.name for x in model.sensors])
