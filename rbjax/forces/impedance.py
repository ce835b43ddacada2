"""Impedance, reference acceleration and regularisation of MuJoCo's soft rows.

A row is a joint limit, the friction loss of a dof, a contact or a soft equality. With the residual
r, its rate J v and the inverse inertia w of the row,

    d(r) = d_0 + (d_w - d_0) y(|r| / width),   y(x) = x^p / m^(p-1)                if x <= m
                                               y(x) = 1 - (1-x)^p / (1-m)^(p-1)    if m < x < 1
                                               y(x) = 1                            if x >= 1
    a_ref = -b J v - k d r,     R = (1 - d) / d w

d is the mean of d_0 and d_w if the width is zero. solref = (time constant T, damping ratio z) gives
k = 1 / (d_w T z)^2 and b = 2 / (d_w T). solref = (-stiffness, -damping), neither above zero, gives
k = stiffness / d_w^2 and b = damping / d_w. Other signs stand for the default of MuJoCo.

In the step map of MuJoCo's `discrete` integrator the spring and the damper of a row act at the end
of a step h:

    f = 1 + h b + h^2 k d,   a_ref = (-k d r - (b + h k d) J v) / f
    R = max((1 - d) / (d f), (1 - 0.9999) / 0.9999) w

The functions act entry by entry on lanes. Parameters that are constants while tracing are folded.

Source: MuJoCo, *Computation*, constraint model, parameters; Todorov 2014.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, add, is_literal, mul, neg
from rbjax.model.solver_parameters import SOLREF

#: a few lanes, or an array with an axis of them in front
Lanes = Sequence[Lane] | np.ndarray | jax.Array

#: MuJoCo's limits of d_0, d_w and of the midpoint m
IMPEDANCES = 1e-4, 0.9999
#: MuJoCo's smallest width, denominator and regularisation
LEAST = 1e-15


def impedance(r: Lane, solimp: Lanes) -> Lane:
    """Compute the impedance d of a row at a residual.

    Derivatives are finite everywhere. The derivative by r is zero at r = 0.

    Args:
        r: the residual of the row, m or rad. Only its absolute value matters.
        solimp: the five lanes d_0, d_w, width, midpoint m, power p, or an array (5, ...).
    """
    r, *solimp = _constants(r, *solimp)
    low, high, width, middle, power = solimp
    low, high, middle = (_clip(x, *IMPEDANCES) for x in (low, high, middle))
    flat = width <= LEAST
    x = _magnitude(r) / _where(flat, 1.0, width)
    rising = x <= middle
    rest = _where(rising, x / middle, _clip(1 - x, 0.0, 1.0) / (1 - middle))
    part = _power(rest, _larger(power, 1.0))
    y = _where(rising, middle * part, 1 - (1 - middle) * part)
    d = _where(x >= 1, high, add(low, mul(y, high - low)))
    return _where(flat, 0.5 * (low + high), d)


def reference(
    r: Lane, velocity: Lane, d: Lane, solref: Lanes, solimp: Lanes, dt: Lane,
    *, refsafe: bool,
) -> Lane:  # fmt: skip
    """Compute the reference acceleration of a row, -b J v - k d r.

    Friction loss and the tangents of an elliptic cone have k = 0, which r = 0.0 gives.

    Args:
        r: the residual of the row.
        velocity: J v, the rate of the residual.
        d: the impedance. The impedance of a connect or weld is at the norm of all its residuals.
        solref: two lanes, or an array (2, ...).
        solimp: as in `impedance`.
        dt: the time step, s.
        refsafe: static, whether the time constant is at least 2 dt.
    """
    r, velocity, d, *solref, high, dt = _constants(r, velocity, d, *solref, solimp[1], dt)
    k, b = _stiffness_and_damping(solref, _clip(high, *IMPEDANCES), dt if refsafe else None)
    return add(mul(-b, velocity), mul(mul(-k, d), r))


class EndOfStep(NamedTuple):
    """The terms of a row whose spring and damper act at the end of a step.

    Fields:
        R: the regularisation.
        spring: k d / f, the factor of the residual in the reference acceleration.
        damper: (b + h k d) / f, the factor of the rate of the residual.
        factor: f.
    """

    R: Lane
    spring: Lane
    damper: Lane
    factor: Lane

    def reference(self, r: Lane, velocity: Lane) -> Lane:
        """Compute the reference acceleration at the residual r and its rate `velocity`."""
        return neg(add(mul(self.spring, r), mul(self.damper, velocity)))


def end_of_step(
    d: Lane, weight: Lane, solref: Lanes, solimp: Lanes, dt: Lane,
    *, spring: bool = True, resolve: bool = False,
) -> EndOfStep:  # fmt: skip
    """Compute the terms of a row of the `discrete` integrator.

    Args:
        d: the impedance.
        weight: the inverse inertia of the row.
        solref, solimp, dt: as in `reference`.
        spring: static, whether the row has a spring.
        resolve: static, whether a spring with h^2 k d > 1 is replaced by the stiffest spring of the
            same damping ratio that does not rebound.
    """
    d, weight, *solref, high, dt = _constants(d, weight, *solref, solimp[1], dt)
    k, b = _stiffness_and_damping(solref, _clip(high, *IMPEDANCES), None)
    if not spring:
        k = 0.0
    elif resolve:
        k, b = _resolved(k, b, d, solref, dt)
    pull = mul(k, d)
    factor = add(1.0, add(mul(dt, b), mul(mul(dt, dt), pull)))
    most = IMPEDANCES[1]
    R = _larger((1 - d) / d * weight, LEAST) / factor
    R = _larger(R, _larger((1 - most) / most * weight, LEAST))
    return EndOfStep(R, pull / factor, add(b, mul(dt, pull)) / factor, factor)


def _resolved(k: Lane, b: Lane, d: Lane, solref: Sequence[Lane], dt: Lane) -> tuple[Lane, Lane]:
    """Return stiffness and damping of a row with a time constant, not above the largest
    values that a step resolves."""
    first, second = solref
    excess = mul(mul(mul(dt, dt), k), d)
    stiff = (excess > 1) & ((first > 0) | (second > 0))
    most = IMPEDANCES[1]
    largest = most * (1 - d) / (d * (1 - most))
    weaker = b / _root(_where(stiff, excess, 1.0))
    least = _larger(largest - 2, 0.0) / dt
    damping = _where(weaker < least, weaker, least)
    return _where(stiff, 1 / (dt * dt * d), k), _where(stiff, damping, b)


def regularisation(d: Lane, weight: Lane) -> Lane:
    """Compute the regularisation R = max(1e-15, (1 - d) / d w) of a row of inverse inertia w."""
    d, weight = _constants(d, weight)
    return _larger((1 - d) / d * weight, LEAST)


def stiffness_and_damping(
    solref: Lanes, solimp: Lanes, dt: Lane | None = None
) -> tuple[Lane, Lane]:
    """Compute the stiffness k, 1/s^2, and the damping b, 1/s, of a row. If dt is given, the time
    constant is at least 2 dt."""
    *solref, high = _constants(*solref, solimp[1])
    return _stiffness_and_damping(solref, _clip(high, *IMPEDANCES), dt)


def _stiffness_and_damping(
    solref: Sequence[Lane], high: Lane, dt: Lane | None
) -> tuple[Lane, Lane]:
    """Compute k and b. `high` is d_w within its limits. The time constant is 2 dt or more."""
    first, second = solref
    standard = first > 0
    mixed = standard != (second > 0)
    time, ratio = (_where(mixed, given, x) for given, x in zip(SOLREF, solref, strict=True))
    standard = standard | mixed
    time = _where(standard, time if dt is None else _larger(time, 2 * dt), 1.0)
    ratio = _where(standard, ratio, 1.0)
    stiffness = _where(standard, 1 / _larger((high * time * ratio) ** 2, LEAST), -first / high**2)
    return stiffness, _where(standard, 2 / _larger(high * time, LEAST), -second / high)


def _constants(*lanes: Lane) -> list[Lane]:
    """Convert each lane by `_constant`, to the dtype of the first tracer."""
    dtype = next((x.dtype for x in lanes if isinstance(x, jax.core.Tracer)), np.float64)
    return [_constant(x, dtype) for x in lanes]


def _constant(x: Lane, dtype: Any) -> Lane:
    """Cast a traced lane to the dtype. Convert a scalar constant to a float, and other constants to
    numpy."""
    if isinstance(x, jax.core.Tracer):
        return x.astype(dtype)
    return float(x) if np.ndim(x) == 0 else np.asarray(x, dtype)


def _module(*lanes: Any) -> Any:
    """Return jax.numpy if a lane is traced or a JAX array, else numpy."""
    return jnp if any(isinstance(x, jax.Array) for x in lanes) else np


def _where(condition: Any, x: Lane, y: Lane) -> Lane:
    """Return x if the condition holds, else y. A condition on literals selects while tracing."""
    if isinstance(condition, (bool, np.bool_)):
        return x if condition else y
    return _module(condition, x, y).where(condition, x, y)


def _magnitude(x: Lane) -> Lane:
    """Compute |x|, with a zero derivative at x = 0."""
    return abs(x) if is_literal(x) else x * _module(x).sign(x)


def _root(x: Lane) -> Lane:
    """Compute sqrt(x)."""
    return math.sqrt(x) if is_literal(x) else _module(x).sqrt(x)


def _larger(x: Lane, least: Lane) -> Lane:
    """Compute max(x, least)."""
    literal = is_literal(x) and is_literal(least)
    return max(x, least) if literal else _module(x, least).maximum(x, least)


def _clip(x: Lane, low: float, high: float) -> Lane:
    """Limit a lane to an interval."""
    return min(max(x, low), high) if is_literal(x) else _module(x).clip(x, low, high)


def _power(x: Lane, power: Lane) -> Lane:
    """Compute x^power. For a literal integer power it is a product of x, with derivatives of any
    order."""
    if is_literal(power) and power == int(power):
        return x ** int(power)
    return x**power
