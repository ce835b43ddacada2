"""The inner state of an actuator between its control and its force: lag, wind-up, recruitment.

    integrator  a' = u,      filter  a' = (u - a) / T,      muscle  a' = (u - a) / T(u, a)
(MuJoCo, *Computation*, stateful actuators.) A step keeps the state within its range; that of an
exact filter is the solution for a held control, a + (u - a) (1 - exp(-h / T)).
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.actuators.limits import clip
from rbjax.lanes import Lane, is_literal
from rbjax.model.leaves import scalar, table
from rbjax.model.links import lane
from rbjax.model.model import Record

#: as MuJoCo's mjMINVAL: no divisor is smaller
LEAST = 1e-15


class Activation(Record):
    """One number a of state. `limits` (2,) are its range, infinite where there is none."""

    limits: jax.Array

    @property
    def follows(self) -> bool:
        """Whether the control is the value that the state approaches, and not its rate."""
        return True

    @abc.abstractmethod
    def rate(self, u: Lane, a: Lane) -> Lane:
        """a' under the control u."""

    def advanced(self, u: Lane, a: Lane, h: Any) -> Lane:
        """a after a step h under a held control."""
        return self.within(a + h * self.rate(u, a))

    def within(self, a: Lane, period: Lane | None = None) -> Lane:
        """Clip a to its range. With a period (of an angle), a value that differs from one of the
        range by full periods is left as it is: `advanced` clips first, and then adds periods."""
        limits = table(self.limits, a.dtype)[None]
        near = clip(a, limits, 0)
        if period is None or near is a:
            return near
        same = a - period * jnp.round((a - near) / period)
        rounding = 4 * jnp.finfo(a.dtype).eps * (jnp.abs(a) + period)
        return jnp.where(jnp.abs(same - clip(same, limits, 0)) <= rounding, a, near)


class Integrator(Activation):
    """a' = u."""

    @property
    def follows(self) -> bool:
        return False

    def rate(self, u: Lane, a: Lane) -> Lane:
        return u


class Filter(Activation):
    """a' = (u - a) / T; `exact`: its steps are the exact solution."""

    time_constant: jax.Array
    exact: bool = eqx.field(static=True)

    def rate(self, u: Lane, a: Lane) -> Lane:
        return (u - a) / at_least(scalar(self.time_constant, a.dtype))

    def advanced(self, u: Lane, a: Lane, h: Any) -> Lane:
        if not self.exact:
            return super().advanced(u, a, h)
        return self.within(a + decayed(h, scalar(self.time_constant, a.dtype), u - a))


class Recruitment(Activation):
    """Of a muscle: time constants (2,) of activation and deactivation, both longer where that is
    further to go (Millard et al., 2013), and the width of a smooth change between the two."""

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
    """0 below 0, 1 above 1, and 6 x^5 - 15 x^4 + 10 x^3 between."""
    x = jnp.clip(x, 0.0, 1.0)
    return x * x * x * (3 * x * (2 * x - 5) + 10)


def decayed(h: Any, time_constant: Lane, gap: Lane) -> Lane:
    """How much of a gap a lag of first order closes in h."""
    return -jnp.expm1(jnp.asarray(-h / at_least(time_constant), gap.dtype)) * gap


def at_least(x: Lane) -> Lane:
    """x as a divisor."""
    return max(x, LEAST) if is_literal(x) else jnp.maximum(x, LEAST)
