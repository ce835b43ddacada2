"""Rolling resistance: what deforming the tyre costs, a torque on the wheel."""

from __future__ import annotations

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.lanes import Lane
from rbjax.model.record import Record, check_number, floats
from rbjax.wheeled.tyres.tyre import check_above, check_at_least


class RollingResistance(Record):
    """A torque against rolling, -c N r tanh(r phi' / v_n), smooth where the wheel stands.

    Fields: coefficient c (), 0.005 to 0.03 for tyres on hard ground; smooth_speed v_n (), m/s,
    above 0.

    Source: Jazar, *Vehicle Dynamics*, 3.4.

    Example:
        >>> import rbjax as rb
        >>> round(float(rb.wheeled.RollingResistance(0.01).torque(2000.0, 0.3, 5.0)), 6)
        -6.0
    """

    coefficient: jax.Array = eqx.field(converter=floats)
    smooth_speed: jax.Array = eqx.field(converter=floats, default=0.05)

    def __check_init__(self) -> None:
        for name in ("coefficient", "smooth_speed"):
            check_number(self, name)
        check_above(self, smooth_speed=0.0)
        check_at_least(self, coefficient=0.0)

    def torque(self, load: Lane, radius: Lane, roll_speed: Lane) -> Lane:
        """The torque on the wheel about its axle, N m.

        Args:
            load: N, N.
            radius: r, m.
            roll_speed: r phi', m/s.
        """
        return -self.coefficient * load * radius * jnp.tanh(roll_speed / self.smooth_speed)
