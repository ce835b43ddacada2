"""Tyre laws: the traction of a contact by its slip; rolling resistance.

In the axes of a wheel on its ground (x along the heading, y across), u is the velocity of the
wheel's centre and r phi' the rolling speed. The sliding velocity v_s and the slip s are

    v_s = (u_x - r phi', u_y),      s = v_s / sqrt((r phi')^2 + v_n^2)

Far above v_n this is the theoretical slip (Pacejka, 3.1). v_n keeps s smooth where the wheel
stands, but then the wheel creeps at v_n s(mu) under the traction mu. `Relaxing` tyres allow a v_n
so small that this does not matter. A law gives the force on the wheel for each newton of load by
two secants, positive and finite, so the power of sliding is never positive:

    mu = -(G_x s_x, G_y s_y),       mu . v_s = -(G_x v_sx^2 + G_y v_sy^2) / |...| <= 0

Combined slip is by similarity (Pacejka, 4.3): the slip of each axis is normalised, and each axis
follows its own curve f_i of the combined slip,

    sigma_i = s_i / s_i*,   rho = |sigma|,   mu_i = -f_i(rho) sigma_i / rho

With f_i <= mu_i* the traction is within the friction ellipse, (mu_x / mu_x*)^2 + (mu_y / mu_y*)^2
<= 1. Coefficients do not depend on the load. They may be complex, for complex-step derivatives.
"""

# no `from __future__ import annotations`: equinox reads AbstractVar from the annotation itself

import abc
import math
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane
from rbjax.model.record import Record
from rbjax.wheeled.fields import check_ranges, number

Pair = tuple[Lane, Lane]  # along the wheel's x and y


class Tyre(Record):
    """Base class of tyre laws. A subclass defines `secants` and `slopes`.

    Each coefficient is one number for both axes, (), or one along and one across, (2,).

    Fields:
        smooth_speed: v_n (), m/s, above 0.

    Class fields:
        positive: names of the coefficients that must be above zero.
        limit: the name of the coefficient of the largest traction, if the law has one.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> class Viscous(rb.wheeled.Tyre):
        ...     smooth_speed: jax.Array
        ...     slope: jax.Array
        ...     @property
        ...     def slopes(self):
        ...         return self.slope, self.slope
        ...     def secants(self, sx, sy):
        ...         return self.slopes
        >>> [float(x) for x in Viscous(jnp.array(0.1), jnp.array(5.0)).traction(-0.1, 0.0)]
        [0.5, -0.0]
    """

    positive: ClassVar[tuple[str, ...]] = ()
    limit: ClassVar[str] = "friction"
    smooth_speed: eqx.AbstractVar[jax.Array]

    def __check_init__(self) -> None:
        above = {"smooth_speed": 0.0} | dict.fromkeys(self.positive, 0.0)
        check_ranges(self, per_axis=True, above=above)

    @property
    def size(self) -> int:
        """The number of states, zero for a law without relaxation."""
        return 0

    @property
    @abc.abstractmethod
    def slopes(self) -> Pair:
        """The secants at zero slip."""

    @property
    def limits(self) -> Pair:
        """The largest traction along and across; infinite if there is no limit."""
        limit = getattr(self, self.limit, None)
        return (math.inf, math.inf) if limit is None else pair(limit)

    @abc.abstractmethod
    def secants(self, sx: Lane, sy: Lane) -> Pair:
        """Compute the secants G_x, G_y of the law, above 0: traction over slip on each axis."""

    def traction(self, sx: Lane, sy: Lane) -> Pair:
        """Compute the force on the wheel per newton of load: minus secant times slip, along and
        across."""
        along, across = self.secants(sx, sy)
        return -along * sx, -across * sy

    def reference_speed(self, roll_speed: Lane) -> Lane:
        """Compute the denominator of the slip, sqrt(roll_speed^2 + smooth_speed^2), m/s."""
        return jnp.sqrt(roll_speed * roll_speed + self.smooth_speed * self.smooth_speed)

    def slip(self, ux: Lane, uy: Lane, roll_speed: Lane) -> Pair:
        """Compute the slip (along, across) from the velocity of the wheel's centre and the rolling
        speed.

        ux, uy: the velocity of the centre in the wheel's axes, m/s. roll_speed: radius times wheel
            rate, m/s.
        """
        inverse = 1 / self.reference_speed(roll_speed)
        return (ux - roll_speed) * inverse, uy * inverse

    def response(self, ux: Lane, uy: Lane, roll_speed: Lane, z: Any = ()) -> tuple[Pair, Any]:
        """Compute the traction (along, across), and the rates of the state z, which is empty.

        ux, uy: the velocity of the centre in the wheel's axes, m/s. roll_speed: radius times wheel
            rate, m/s.
        """
        return self.traction(*self.slip(ux, uy, roll_speed)), ()

    def damping(self, vx: Lane, vy: Lane, roll_speed: Lane, h: Lane) -> Pair:
        """Compute the damping of the sliding velocity, secant / `reference_speed`, along and
        across, s/m.

        h: the step, s, which only laws with a state use.
        """
        inverse = 1 / self.reference_speed(roll_speed)
        along, across = self.secants(vx * inverse, vy * inverse)
        return along * inverse, across * inverse

    def stored(self, z: Any = ()) -> Lane:
        """Return the stored energy per newton of load, m: zero for a law without relaxation."""
        return 0.0


def pair(x: Any) -> Pair:
    """Return a coefficient along and across, as floats if it is known while tracing."""
    if not jnp.ndim(x):
        return x, x
    return (float(x[0]), float(x[1])) if isinstance(x, np.ndarray) else (x[0], x[1])


class RollingResistance(Record):
    """A torque against rolling, -c N r tanh(r phi' / v_n), smooth at rest.

    Fields:
        coefficient: c (), 0.005 to 0.03 for tyres on hard ground.
        smooth_speed: v_n (), m/s, above 0.

    Source: Jazar, *Vehicle Dynamics*, 3.4.

    Example:
        >>> import rbjax as rb
        >>> round(float(rb.wheeled.RollingResistance(0.01).torque(2000.0, 0.3, 5.0)), 6)
        -6.0
    """

    coefficient: jax.Array = number()
    smooth_speed: jax.Array = number(default=0.05)

    def __check_init__(self) -> None:
        check_ranges(self, above={"smooth_speed": 0.0}, least={"coefficient": 0.0})

    def torque(self, load: Lane, radius: Lane, roll_speed: Lane) -> Lane:
        """Compute the torque on the wheel about its axle, N m.

        Args:
            load: N, N.
            radius: r, m.
            roll_speed: r phi', m/s.
        """
        return -self.coefficient * load * radius * jnp.tanh(roll_speed / self.smooth_speed)
