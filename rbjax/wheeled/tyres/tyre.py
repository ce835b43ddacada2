"""What a tyre law is: from the slip of the contact to its traction.

In the axes of a wheel on its ground (x where it rolls, y across), u is the velocity of the wheel's
centre and r phi' the speed at which the rim comes round. The contact slides at v_s, and slips by s:

    v_s = (u_x - r phi', u_y),      s = v_s / sqrt((r phi')^2 + v_n^2)

Far above v_n this is the theoretical slip, by the speed of rolling: for a brush of bristles, long
and lateral slips of one size then deflect it equally (Pacejka, 3.1). A locked wheel slips without
bound, one that spins on the spot by -1. v_n keeps s smooth where the wheel stands. It has a price:
a wheel that stands under the traction mu creeps at v_n s(mu). `Relaxing` tyres can afford a v_n
that makes this invisible.

A law gives the force on the wheel for each newton of load by two secants, positive and finite:

    mu = -(G_x s_x, G_y s_y),       mu . v_s = -(G_x v_sx^2 + G_y v_sy^2) / |...| <= 0

so that no law ever drives what slides. Combined slip is by similarity (Pacejka, 4.3): each axis has
a slip of its own, s_i, with which it is measured, and follows its own curve f_i of what both make,

    sigma_i = s_i / s_i*,   rho = |sigma|,   mu_i = -f_i(rho) sigma_i / rho

With f_i <= mu_i* this stays within the ellipse of friction, (mu_x / mu_x*)^2 + (mu_y / mu_y*)^2
<= 1. Everything is a few operations on scalars. Coefficients do not depend on the load. They may
be complex, for derivatives by complex steps.
"""

# no `from __future__ import annotations`: equinox reads AbstractVar from the annotation itself

import abc
import math
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_number
from rbjax.errors import InputError
from rbjax.lanes import Lane
from rbjax.model.record import Record, check_fields, check_number, check_numbers

Pair = tuple[Lane, Lane]  # along the wheel's x and y


class Tyre(Record):
    """A tyre law. A subclass gives `secants` and `slopes`; each coefficient is one number for both
    axes, (), or one along and one across, (2,).

    Fields: smooth_speed () v_n, m/s, above 0.

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

    smooth_speed: eqx.AbstractVar[jax.Array]

    def __check_init__(self) -> None:
        check_coefficients(self)
        check_number(self, "smooth_speed")
        check_above(self, smooth_speed=0.0)
        self.check_ranges()

    def check_ranges(self) -> None:
        """Refuse coefficients of which the law makes no sense (`check_above`, `check_up_to`)."""

    @property
    def size(self) -> int:
        """How many numbers of state it has: none."""
        return 0

    @property
    @abc.abstractmethod
    def slopes(self) -> Pair:
        """The secants where nothing slips."""

    @property
    def limits(self) -> Pair:
        """The most traction along and across; infinite where there is no limit."""
        return math.inf, math.inf

    @abc.abstractmethod
    def secants(self, sx: Lane, sy: Lane) -> Pair:
        """G_x and G_y, above 0, at the slip s."""

    def traction(self, sx: Lane, sy: Lane) -> Pair:
        """The force on the wheel for each newton of load, -(G_x s_x, G_y s_y)."""
        along, across = self.secants(sx, sy)
        return -along * sx, -across * sy

    def reference_speed(self, roll_speed: Lane) -> Lane:
        """sqrt((r phi')^2 + v_n^2), m/s: what the sliding velocity is measured by."""
        return jnp.sqrt(roll_speed * roll_speed + self.smooth_speed * self.smooth_speed)

    def slip(self, ux: Lane, uy: Lane, roll_speed: Lane) -> Pair:
        """s, of the wheel centre's velocity u, m/s in the wheel's axes, and r phi', m/s."""
        inverse = 1 / self.reference_speed(roll_speed)
        return (ux - roll_speed) * inverse, uy * inverse

    def response(self, ux: Lane, uy: Lane, roll_speed: Lane, z: Any = ()) -> tuple[Pair, Any]:
        """The traction of a motion, and the rate of the state z, which is empty here."""
        return self.traction(*self.slip(ux, uy, roll_speed)), ()

    def damping(self, vx: Lane, vy: Lane, roll_speed: Lane, h: Lane) -> Pair:
        """G_i / sqrt((r phi')^2 + v_n^2), s/m: how the traction opposes the sliding velocity v_s.

        h: of the step, s, which laws with a state need.
        """
        inverse = 1 / self.reference_speed(roll_speed)
        along, across = self.secants(vx * inverse, vy * inverse)
        return along * inverse, across * inverse

    def stored(self, z: Any = ()) -> Lane:
        """The energy that its state stores for each newton of load, in metres: none."""
        return 0.0


def traction_along(
    law: Tyre, ux: Lane, uy: Lane, roll_speed: Lane, direction: tuple[Lane, Lane]
) -> Pair:
    """The traction of a wheel whose rim carries free rollers: only that along their axis.

        v_a = a . v_s,   s = v_a / sqrt((r phi')^2 + v_n^2),   mu = -G_x(s, 0) s a

    Args:
        law: its numbers along x serve along a.
        ux, uy: the velocity of the wheel's centre, m/s in the wheel's axes.
        roll_speed: r phi', m/s.
        direction: a, the unit vector of the axis of the roller that touches, in the wheel's axes:
            (cos 45, sin 45 degrees) for one hand of mecanum wheels, (1, 0) for an omni wheel whose
            rollers let it slide sideways.

    Example:
        >>> import rbjax as rb
        >>> rubber = rb.wheeled.Linear(10.0)
        >>> mu = rb.wheeled.traction_along(rubber, 0.9, 5.0, 1.0, (1.0, 0.0))
        >>> [round(float(x), 2) for x in mu]
        [1.0, 0.0]
    """
    if not isinstance(law, Tyre):
        raise InputError(f"traction_along: law is {type(law).__name__}, expected a Tyre")
    pair: Any = direction
    size = len(pair) if isinstance(pair, (tuple, list)) else getattr(pair, "shape", (0,))[:1]
    if size not in (2, (2,)):
        raise InputError(f"traction_along: direction is {direction!r}, expected two numbers")
    given = {"ux": (ux,), "uy": (uy,), "roll_speed": (roll_speed,), "direction": direction}
    for name, numbers in given.items():
        for x in numbers:
            lane = hasattr(x, "dtype") and jnp.issubdtype(x.dtype, jnp.inexact)
            if not lane or isinstance(x, np.floating):  # arrays, complex ones too, are lanes
                real_number("traction_along", name, x)
    ax, ay = direction
    slides = (ux - roll_speed) * ax + uy * ay
    mu, _ = law.traction(slides / law.reference_speed(roll_speed), jnp.zeros_like(slides))
    return mu * ax, mu * ay


# ------------------------------------------------------------------------- for the laws


def pair(x: Any) -> Pair:
    """A coefficient along and across; literals if it is known while tracing."""
    if not jnp.ndim(x):
        return x, x
    return (float(x[0]), float(x[1])) if isinstance(x, np.ndarray) else (x[0], x[1])


def check_coefficients(record: Record) -> None:
    """Refuse coefficients that are no numbers of the shape () or (2,)."""
    check_fields(record)
    for name, value in vars(record).items():
        if value is None or isinstance(value, Record):
            continue
        where = f"{type(record).__name__}({name}=...)"
        check_numbers(where, value, endless=False)
        if jnp.shape(value) not in ((), (2,)):
            raise InputError(
                f"{where}: got the shape {jnp.shape(value)}, expected a number, or (2,): one along "
                "the wheel and one across; for many tyres use jax.vmap over them"
            )


def check_above(record: Record, **least: Any) -> None:
    """Refuse coefficients that are not above these values, where both are known."""
    _check(record, least, np.greater, "above")


def check_at_least(record: Record, **least: Any) -> None:
    """Refuse coefficients that are below these values, where both are known."""
    _check(record, least, np.greater_equal, "of at least")


def check_up_to(record: Record, **most: Any) -> None:
    """Refuse coefficients that are above these values, where both are known."""
    _check(record, most, np.less_equal, "of at most")


def _check(record: Record, ends: dict[str, Any], within: Any, says: str) -> None:
    for name, end in ends.items():
        value = getattr(record, name)
        if value is None or any(isinstance(x, jax.core.Tracer) for x in (value, end)):
            continue
        if not np.all(within(np.asarray(value), np.asarray(end))):
            raise InputError(
                f"{type(record).__name__}({name}=...): got {np.asarray(value).tolist()}, expected "
                f"numbers {says} {np.asarray(end).tolist()}"
            )
