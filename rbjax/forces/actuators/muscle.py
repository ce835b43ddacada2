"""The force of a muscle: active by length and speed, passive by length.

    f = -F0 (FL(L) FV(V) a + FP(L)),      L = (l - LT) / L0,      V = l' / (L0 vmax)
FL rises from 0 at lmin to 1 at 1 and falls to 0 at lmax, FV falls from fvmax where the muscle
lengthens to 0 at V = -1, FP begins at L = 1 (MuJoCo, *Modeling*, muscles). All three are pieces of
parabolas with a continuous slope.
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.actuators.activation import at_least
from rbjax.lanes import Lane
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.model.model import Record


class Muscle(Record):
    """Numbers of a muscle's curves.

    Fields: parameters (9,), [range of L (2); F0; scale; lmin; lmax; vmax; fpmax; fvmax];
    lengthrange (2,), lengths of the transmission at the range of L; acceleration (), what a unit
    force accelerates at rest. `scaled`: F0 is scale / acceleration, and the third number unused.
    """

    parameters: jax.Array
    lengthrange: jax.Array
    acceleration: jax.Array
    scaled: bool = eqx.field(static=True)

    def active(self, length: Lane, speed: Lane, dtype: Any) -> Lane:
        """The force at full activation."""
        _, lmin, lmax, vmax, _, fvmax = p = self._numbers(dtype)
        L, optimal = self._scaled_length(length, dtype)
        V = speed / at_least(optimal * vmax)
        return -p[0] * length_curve(L, lmin, lmax) * speed_curve(V, fvmax)

    def passive(self, length: Lane, dtype: Any) -> Lane:
        """The force of a muscle that is stretched and not active."""
        peak, _, lmax, _, fpmax, _ = self._numbers(dtype)
        L, _ = self._scaled_length(length, dtype)
        return -peak * fpmax * passive_curve(L, lmax)

    def _numbers(self, dtype: Any) -> list[Lane]:
        """F0, lmin, lmax, vmax, fpmax, fvmax."""
        column = table(self.parameters, dtype)
        _, _, peak, scale, *rest = (lane(column, i) for i in range(9))
        if self.scaled:
            peak = scale / at_least(lane(table(self.acceleration, dtype)[None], 0))
        return [peak, *rest]

    def _scaled_length(self, length: Lane, dtype: Any) -> tuple[Lane, Lane]:
        """L, and L0."""
        column, limits = table(self.parameters, dtype), table(self.lengthrange, dtype)
        low, high = lane(column, 0), lane(column, 1)
        least, most = lane(limits, 0), lane(limits, 1)
        optimal = (most - least) / at_least(high - low)
        return jnp.asarray(low + (length - least) / at_least(optimal), dtype), optimal


def length_curve(L: Lane, lmin: Lane, lmax: Lane) -> Lane:
    """FL: 0, and half parabolas with knots at lmin, (lmin + 1) / 2, 1, (1 + lmax) / 2, lmax."""
    a, b = 0.5 * (lmin + 1), 0.5 * (1 + lmax)
    rise = 0.5 * _square((L - lmin) / at_least(a - lmin))
    before = 1 - 0.5 * _square((1 - L) / at_least(1 - a))
    after = 1 - 0.5 * _square((L - 1) / at_least(b - 1))
    fall = 0.5 * _square((lmax - L) / at_least(lmax - b))
    short = jnp.where(a >= L, rise, before)
    long = jnp.where(b >= L, after, fall)
    return jnp.where((lmin > L) | (lmax < L), 0.0, jnp.where(L <= 1, short, long))


def speed_curve(V: Lane, fvmax: Lane) -> Lane:
    """FV: 0 up to V = -1, 1 at rest, fvmax from V = fvmax - 1 on."""
    y = fvmax - 1
    lengthening = fvmax - _square(jnp.maximum(y - V, 0.0)) / at_least(y)
    return jnp.where(V <= 0, _square(jnp.maximum(V + 1, 0.0)), lengthening)


def passive_curve(L: Lane, lmax: Lane) -> Lane:
    """FP / fpmax: 0 up to L = 1, half a parabola up to (1 + lmax) / 2, then its tangent."""
    width = at_least(0.5 * (1 + lmax) - 1)
    x = jnp.maximum((L - 1) / width, 0.0)
    return jnp.where(x <= 1, 0.5 * x * x, x - 0.5)


def _square(x: Lane) -> Lane:
    return x * x
