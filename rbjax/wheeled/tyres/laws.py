"""Five tyre laws: Coulomb, linear, Fiala's brush, the magic formula, TMeasy.

Each law computes the secants G_i of `Tyre` from its curve f(rho) of pure slip. sigma_i is the
normalised slip of an axis and rho = |sigma| (see `tyre`).
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.lanes import Lane
from rbjax.wheeled.fields import check_ranges, number
from rbjax.wheeled.tyres.tyre import Pair, Tyre, pair

#: the default of v_n, m/s
SMOOTH_SPEED = 0.05


class LinearTyre(Tyre):
    """Traction proportional to slip, with or without a limit.

        mu_i = -c_i s_i,    with a limit    mu_i = -mu_i* sigma_i / sqrt(1 + rho^2),
                                            sigma_i = c_i s_i / mu_i*

    Fields:
        stiffness: c, () or (2,).
        friction: mu*, () or (2,), or None for no limit.
        smooth_speed: v_n (), m/s.

    Source: Jazar, *Vehicle Dynamics*, 3.5.

    Example:
        >>> import rbjax as rb
        >>> rubber = rb.wheeled.LinearTyre([12.0, 10.0])
        >>> [round(float(x), 3) for x in rubber.traction(-0.02, 0.01)]
        [0.24, -0.1]
    """

    positive = ("stiffness", "friction")
    stiffness: jax.Array = number()
    friction: jax.Array | None = number(default=None)
    smooth_speed: jax.Array = number(default=SMOOTH_SPEED)

    @property
    def slopes(self) -> Pair:
        return pair(self.stiffness)

    def secants(self, sx: Lane, sy: Lane) -> Pair:
        if self.friction is None:
            return self.slopes
        return _saturated(self.slopes, pair(self.friction), sx, sy)


class Coulomb(Tyre):
    """Coulomb friction, regularised.

        mu_i = -mu_i* sigma_i / sqrt(1 + rho^2),    sigma_i = s_i / w_i

    Fields:
        friction: mu*, () or (2,).
        width: w, () or (2,), the slip at which the traction is 0.71 mu*.
        smooth_speed: v_n (), m/s.

    Example:
        >>> import rbjax as rb
        >>> [round(float(x), 3) for x in rb.wheeled.Coulomb(0.8).traction(3.0, 4.0)]
        [-0.48, -0.64]
    """

    positive = ("friction", "width")
    friction: jax.Array = number()
    width: jax.Array = number(default=0.02)
    smooth_speed: jax.Array = number(default=SMOOTH_SPEED)

    @property
    def slopes(self) -> Pair:
        return pair(self.friction / self.width)

    def secants(self, sx: Lane, sy: Lane) -> Pair:
        return _saturated(self.slopes, pair(self.friction), sx, sy)


def _root(square: Lane) -> Lane:
    """Compute a square root. Near zero it is zero with zero derivatives, to avoid overflow."""
    some = square > jnp.finfo(jnp.result_type(square)).tiny ** (1 / 3)
    return jnp.where(some, jnp.sqrt(jnp.where(some, square, 1.0)), 0.0)


def _saturated(slopes: Pair, limits: Pair, sx: Lane, sy: Lane) -> Pair:
    (cx, cy), (mx, my) = slopes, limits
    x, y = cx / mx * sx, cy / my * sy
    less = 1 / jnp.sqrt(1 + x * x + y * y)
    return cx * less, cy * less


class Fiala(Tyre):
    """The brush model: bristles under parabolic pressure, which adhere or slide.

        f(rho) = mu* (3 rho - 3 rho^2 + rho^3)   for rho < 1,   mu* beyond
        sigma_i = c_i s_i / (3 mu_i*)

    Fields:
        stiffness: c, () or (2,), the slope at zero slip.
        friction: mu*, () or (2,).
        smooth_speed: v_n (), m/s.

    Source: Fiala 1954; Pacejka, *Tire and Vehicle Dynamics*, eq. 3.7, 3.10 and 3.25.

    Example:
        >>> import rbjax as rb
        >>> [round(float(x), 3) for x in rb.wheeled.Fiala(12.0, 0.8).traction(0.1, 0.0)]
        [-0.7, -0.0]
    """

    positive = ("stiffness", "friction")
    stiffness: jax.Array = number()
    friction: jax.Array = number()
    smooth_speed: jax.Array = number(default=SMOOTH_SPEED)

    @property
    def slopes(self) -> Pair:
        return pair(self.stiffness)

    def secants(self, sx: Lane, sy: Lane) -> Pair:
        cx, cy = self.slopes
        third = self.stiffness / (3 * self.friction)
        x, y = (k * s for k, s in zip(pair(third), (sx, sy), strict=True))
        rho = _root(x * x + y * y)
        adheres = rho < 1
        slides = jnp.where(adheres, 1.0, rho)
        share = jnp.where(adheres, 1 - rho + rho * rho / 3, 1 / (3 * slides))
        return cx * share, cy * share


class Pacejka(Tyre):
    """The magic formula.

        f(rho) = D sin(C atan(rho - E (rho - atan rho))),      sigma_i = B_i s_i

    Outside of the ranges below the force would change its sign. It is faster with one C and one E
    for both axes.

    Fields, () or (2,):
        stiffness_factor: B.
        shape: C, above 0 and up to 2.
        peak: D.
        curvature: E, up to 1.
        smooth_speed: v_n, m/s, only ().

    Source: Pacejka, *Tire and Vehicle Dynamics*, eq. 4.49, without shifts, load and camber;
    combined slip after 4.3.1.

    Example:
        >>> import rbjax as rb
        >>> rubber = rb.wheeled.Pacejka(10.0, 1.6, 1.0, 0.5)
        >>> [round(float(x), 3) for x in rubber.traction(-0.1, 0.0)]
        [0.919, -0.0]
    """

    limit = "peak"
    positive = ("stiffness_factor", "shape", "peak")
    stiffness_factor: jax.Array = number()
    shape: jax.Array = number()
    peak: jax.Array = number()
    curvature: jax.Array = number(default=0.0)
    smooth_speed: jax.Array = number(default=SMOOTH_SPEED)

    def __check_init__(self) -> None:
        check_ranges(self, per_axis=True, most={"shape": 2.0, "curvature": 1.0})

    @property
    def slopes(self) -> Pair:
        return pair(self.stiffness_factor * self.shape * self.peak)

    def secants(self, sx: Lane, sy: Lane) -> Pair:
        bx, by = pair(self.stiffness_factor)
        dx, dy = pair(self.stiffness_factor * self.peak)
        x, y = bx * sx, by * sy
        square = x * x + y * y
        # near zero f / rho is a series in rho^2; eps^(1/2) balances the errors of both formulas
        near = square < jnp.finfo(square.dtype).eps ** 0.5
        rho = jnp.sqrt(jnp.where(near, 1.0, square))
        turned = jnp.arctan(rho)

        def curve(c: Lane, e: Lane) -> Lane:
            far = jnp.sin(c * jnp.arctan(rho - e * (rho - turned))) / rho
            return jnp.where(near, c - c * ((1 + e) / 3 + c * c / 6) * square, far)

        if jnp.ndim(self.shape) == jnp.ndim(self.curvature) == 0:
            alike = curve(self.shape, self.curvature)
            return dx * alike, dy * alike
        fx, fy = map(curve, pair(self.shape), pair(self.curvature))
        return dx * fx, dy * fy


class TMeasy(Tyre):
    """Rill's law, defined by points of a measured curve.

        f(rho) = c s_M rho / (1 + rho (c s_M / f_M - 2 + rho))      up to the peak, rho = 1
        f(rho) = f_M - (f_M - f_S) x^2 (3 - 2 x)                    beyond
        f(rho) = f_S                                                from x = 1 on

    with sigma_i = s_i / s_M,i and x = (rho - 1) / (s_S / s_M - 1). Rill blends the coefficients of
    both axes by the direction of slip, which can leave the friction ellipse. In this implementation
    each axis keeps its own curve. Both are the same for equal coefficients along and across.

    Fields, () or (2,):
        slope: c, at zero slip; 2 f_M / s_M or more for a curve without inflection.
        peak_slip: s_M.
        peak: f_M.
        sliding_slip: s_S, above s_M.
        sliding: f_S, up to f_M.
        smooth_speed: v_n, m/s, only ().

    Source: Rill & Castro, *Road Vehicle Dynamics*, 2nd ed. 2020, 3.3; Rill, *TMeasy, the handling
    tire model for all driving situations*, DINAME 2013.

    Example:
        >>> import rbjax as rb
        >>> rubber = rb.wheeled.TMeasy(25.0, 0.1, 1.0, 0.4, 0.8)
        >>> [round(float(x), 3) for x in rubber.traction(-0.1, 0.0)]
        [1.0, -0.0]
    """

    limit = "peak"
    positive = ("slope", "peak_slip", "peak", "sliding")
    slope: jax.Array = number()
    peak_slip: jax.Array = number()
    peak: jax.Array = number()
    sliding_slip: jax.Array = number()
    sliding: jax.Array = number()
    smooth_speed: jax.Array = number(default=SMOOTH_SPEED)

    def __check_init__(self) -> None:
        above = dict.fromkeys(self.positive, 0.0) | {"sliding_slip": "peak_slip"}
        check_ranges(self, per_axis=True, above=above, most={"sliding": "peak"})

    @property
    def slopes(self) -> Pair:
        return pair(self.slope)

    def secants(self, sx: Lane, sy: Lane) -> Pair:
        ix, iy = pair(1 / self.peak_slip)
        x, y = ix * sx, iy * sy
        rho = _root(x * x + y * y)
        rising = rho < 1
        beyond = jnp.where(rising, 1.0, rho)
        bend = self.slope * self.peak_slip / self.peak - 2
        ways = 1 / (self.sliding_slip / self.peak_slip - 1)

        def secant(bend: Lane, ways: Lane, slope: Lane, peak: Lane, fall: Lane, i: Lane) -> Lane:
            part = (beyond - 1) * ways
            part = jnp.where(part < 1, part, 1.0)
            falling = (peak - fall * part * part * (3 - 2 * part)) * i / beyond
            return jnp.where(rising, slope / (1 + rho * (bend + rho)), falling)

        columns = bend, ways, self.slope, self.peak, self.peak - self.sliding, 1 / self.peak_slip
        if all(jnp.ndim(c) == 0 for c in columns):
            alike = secant(*columns)
            return alike, alike
        along, across = zip(*map(pair, columns), strict=True)
        return secant(*along), secant(*across)
