"""Activation states of actuators between a control and a force: integrators, filters, muscles.

    integrator  a' = u,      filter  a' = (u - a) / T,      muscle  a' = (u - a) / T(u, a)
(MuJoCo, *Computation*, stateful actuators.) A step clips the state to its range. The step of an
exact filter is the solution for a constant control, a + (u - a) (1 - exp(-h / T)).

    f = -F0 (FL(L) FV(V) a + FP(L)),      L = (l - LT) / L0,      V = l' / (L0 vmax)
is the force of a muscle. FL rises from 0 at lmin to 1 at L = 1 and falls to 0 at lmax. FV falls
from fvmax for a lengthening muscle to 0 at V = -1. FP is positive for L > 1 (MuJoCo, *Modeling*,
muscles). All three are piecewise parabolas with a continuous slope.
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, is_literal
from rbjax.model.leaves import scalar, table
from rbjax.model.links import lane
from rbjax.model.record import Record


def clip(x: Lane, limits: Any, i: int) -> Lane:
    """Clip x to row i of the limits (n, 2); return x if this row is a literal infinite range."""
    low, high = lane(limits[:, 0], i), lane(limits[:, 1], i)
    if is_literal(low) and np.isneginf(low) and np.isposinf(high):
        return x
    return jnp.clip(x, jnp.asarray(low, x.dtype), jnp.asarray(high, x.dtype))


#: MuJoCo's mjMINVAL, the lower limit of divisors
LEAST = 1e-15


class Activation(Record):
    """Base class of an activation state a between a control and a force. limits: (2,) its range."""

    limits: jax.Array

    @property
    def follows(self) -> bool:
        """Whether a approaches the control; otherwise the control is the rate of a."""
        return True

    @abc.abstractmethod
    def rate(self, u: Lane, a: Lane) -> Lane:
        """Compute the rate a' under the control u."""

    def advanced(self, u: Lane, a: Lane, h: Any) -> Lane:
        """Compute a after a step h with a constant control."""
        return self.within(a + h * self.rate(u, a))

    def within(self, a: Lane, period: Lane | None = None) -> Lane:
        """Clip a to its range.

        period: of a value that is an angle; None otherwise. An angle that differs from one in the
            range by full periods is returned unchanged.
        """
        limits = table(self.limits, a.dtype)[None]
        near = clip(a, limits, 0)
        if period is None or near is a:
            return near
        same = a - period * jnp.round((a - near) / period)
        rounding = 4 * jnp.finfo(a.dtype).eps * (jnp.abs(a) + period)
        return jnp.where(jnp.abs(same - clip(same, limits, 0)) <= rounding, a, near)


class ControlIntegral(Activation):
    """An activation a that integrates the control: a' = u."""

    @property
    def follows(self) -> bool:
        return False

    def rate(self, u: Lane, a: Lane) -> Lane:
        return u


class Filter(Activation):
    """A first-order lag a' = (u - a) / T of the control u, with time constant T.

    exact: whether its steps are the exact solution. It does not change Runge-Kutta methods, which
        integrate a' with their own order. MuJoCo's RK4 first averages the rates of its stages and
        then applies the exact step to the mean, so its error is of order 1.
    """

    time_constant: jax.Array
    exact: bool = eqx.field(static=True)

    def rate(self, u: Lane, a: Lane) -> Lane:
        return (u - a) / at_least(scalar(self.time_constant, a.dtype))

    def advanced(self, u: Lane, a: Lane, h: Any) -> Lane:
        if not self.exact:
            return super().advanced(u, a, h)
        return self.within(a + lag_step(h, scalar(self.time_constant, a.dtype), u - a))


class Recruitment(Activation):
    """The activation of a muscle, with time constants (2,) of activation and deactivation.

    The time constants depend on the activation. `width` smooths the transition between them.
    (Millard et al., 2013)
    """

    time_constants: jax.Array
    width: jax.Array
    smooth: bool = eqx.field(static=True)

    def rate(self, u: Lane, a: Lane) -> Lane:
        column = table(self.time_constants, a.dtype)
        excess = jnp.clip(u, 0.0, 1.0) - a
        slow = 0.5 + 1.5 * jnp.clip(a, 0.0, 1.0)
        rise, fall = lane(column, 0) * slow, lane(column, 1) / slow
        if self.smooth:
            share = excess / scalar(self.width, a.dtype) + 0.5
            time_constant = fall + (rise - fall) * smoothstep(share)
        else:
            time_constant = jnp.where(excess > 0, rise, fall)
        return excess / at_least(time_constant)


def smoothstep(x: Lane) -> Lane:
    """Compute 6 x^5 - 15 x^4 + 10 x^3 for x between 0 and 1; 0 below, 1 above."""
    x = jnp.clip(x, 0.0, 1.0)
    return x * x * x * (3 * x * (2 * x - 5) + 10)


def lag_step(h: Any, time_constant: Lane, gap: Lane) -> Lane:
    """Compute the part of a gap that a first-order lag closes in a step h."""
    return -jnp.expm1(jnp.asarray(-h / at_least(time_constant), gap.dtype)) * gap


def at_least(x: Lane) -> Lane:
    """Bound a divisor from below by MuJoCo's lower limit."""
    return max(x, LEAST) if is_literal(x) else jnp.maximum(x, LEAST)


class Muscle(Record):
    """The parameters of a muscle's curves.

    parameters: (9,) [range of L (2); F0; scale; lmin; lmax; vmax; fpmax; fvmax].
    lengthrange: (2,) lengths of the transmission at the range of L.
    acceleration: () acceleration of the transmission at rest by a unit force.
    scaled: whether F0 is scale / acceleration, and the third parameter is not used; static.
    """

    parameters: jax.Array
    lengthrange: jax.Array
    acceleration: jax.Array
    scaled: bool = eqx.field(static=True)

    def active(self, length: Lane, speed: Lane, dtype: Any) -> Lane:
        """Compute the active force at full activation."""
        _, lmin, lmax, vmax, _, fvmax = p = self._numbers(dtype)
        L, optimal = self._scaled_length(length, dtype)
        V = speed / at_least(optimal * vmax)
        return -p[0] * length_curve(L, lmin, lmax) * speed_curve(V, fvmax)

    def passive(self, length: Lane, dtype: Any) -> Lane:
        """Compute the passive force of a stretched muscle."""
        peak, _, lmax, _, fpmax, _ = self._numbers(dtype)
        L, _ = self._scaled_length(length, dtype)
        return -peak * fpmax * passive_curve(L, lmax)

    def _numbers(self, dtype: Any) -> list[Lane]:
        """Return F0, lmin, lmax, vmax, fpmax, fvmax."""
        column = table(self.parameters, dtype)
        _, _, peak, scale, *rest = (lane(column, i) for i in range(9))
        if self.scaled:
            peak = scale / at_least(lane(table(self.acceleration, dtype)[None], 0))
        return [peak, *rest]

    def _scaled_length(self, length: Lane, dtype: Any) -> tuple[Lane, Lane]:
        """Compute the normalised length L of a muscle, and its optimal length L0."""
        column, limits = table(self.parameters, dtype), table(self.lengthrange, dtype)
        low, high = lane(column, 0), lane(column, 1)
        least, most = lane(limits, 0), lane(limits, 1)
        optimal = (most - least) / at_least(high - low)
        return jnp.asarray(low + (length - least) / at_least(optimal), dtype), optimal


def length_curve(L: Lane, lmin: Lane, lmax: Lane) -> Lane:
    """Compute the force-length factor FL of a muscle at the normalised length L.
    It is half parabolas with knots at lmin, (lmin + 1) / 2, 1, (1 + lmax) / 2, lmax."""
    a, b = 0.5 * (lmin + 1), 0.5 * (1 + lmax)
    rise = 0.5 * _square((L - lmin) / at_least(a - lmin))
    before = 1 - 0.5 * _square((1 - L) / at_least(1 - a))
    after = 1 - 0.5 * _square((L - 1) / at_least(b - 1))
    fall = 0.5 * _square((lmax - L) / at_least(lmax - b))
    short = jnp.where(a >= L, rise, before)
    long = jnp.where(b >= L, after, fall)
    return jnp.where((lmin > L) | (lmax < L), 0.0, jnp.where(L <= 1, short, long))


def speed_curve(V: Lane, fvmax: Lane) -> Lane:
    """Compute the force-velocity factor FV: 0 for V <= -1, 1 at V = 0, fvmax for V >= fvmax - 1."""
    y = fvmax - 1
    lengthening = fvmax - _square(jnp.maximum(y - V, 0.0)) / at_least(y)
    return jnp.where(V <= 0, _square(jnp.maximum(V + 1, 0.0)), lengthening)


def passive_curve(L: Lane, lmax: Lane) -> Lane:
    """Compute the passive force factor FP / fpmax of a muscle at the normalised length L.
    It is 0 for L <= 1, half a parabola up to (1 + lmax) / 2, then its tangent."""
    width = at_least(0.5 * (1 + lmax) - 1)
    x = jnp.maximum((L - 1) / width, 0.0)
    return jnp.where(x <= 1, 0.5 * x * x, x - 0.5)


def _square(x: Lane) -> Lane:
    return x * x
