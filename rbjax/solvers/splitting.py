"""Symplectic compositions of kicks and drifts.

    kick:  v' = a(t, q, v) at constant q        drift:  q' = v at constant v
    symplectic Euler  K(h) D(h);   Stoermer-Verlet  K(h/2) D(h) K(h/2);
    Yoshida  Verlet of steps w_1 h, ..., w_s h, with sum w = 1, sum w^3 = 0, sum w^5 = 0
The state is a pair (q, v). If a does not depend on v, both flows are exact. With a constant mass
the method is then symplectic, and the energy error stays bounded. If a depends on v, a Runge-Kutta
method of at least the same order integrates the kick. The dense output is a cubic. Steps are
constant.

Source: Yoshida, *Physics Letters A* 150, 1990; Hairer, Lubich & Wanner, *Geometric Numerical
Integration*, II.5, V.3, coefficients of (3.11).
"""

from __future__ import annotations

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_array, shown
from rbjax.errors import InputError
from rbjax.lanes.arrays import select
from rbjax.solvers import tableau as tables
from rbjax.solvers.second_order import Halves
from rbjax.solvers.steps import (
    AbstractGroupSolver,
    combine,
    dense_output,
    explicit_stages,
    scale,
    split_pair,
)

_CUBE = 2 ** (1 / 3)
YOSHIDA4 = (1 / (2 - _CUBE), -_CUBE / (2 - _CUBE), 1 / (2 - _CUBE))
_OUTER = (0.784513610477557263819497633866, 0.235573213359358133684793182979,
          -1.17767998417887100694641568096)  # fmt: skip
YOSHIDA6 = (*_OUTER, 1 - 2 * sum(_OUTER), *_OUTER[::-1])


def _kick_method(order: int) -> tables.Tableau:
    """Return an explicit tableau of at least this order, for kicks."""
    if order == 1:
        return tables.EULER
    if order == 2:
        return tables.MIDPOINT
    return tables.RK4 if order <= 4 else tables.of_diffrax(diffrax.Dopri8, 8)


class Splitting(AbstractGroupSolver):
    """A composition of alternating kicks and drifts.

    Fields:
        kicks: fractions of the step, as many as drifts or one more.
        drifts: fractions of the step.
        formula_order: order of the composition.
        velocity_forces: whether a may depend on v. If False, each kick is one evaluation.
    """

    kicks: tuple[float, ...] = eqx.field(static=True)
    drifts: tuple[float, ...] = eqx.field(static=True)
    formula_order: int = eqx.field(static=True)
    velocity_forces: bool = eqx.field(static=True, default=True)

    def __check_init__(self):
        for name in ("kicks", "drifts"):
            x = getattr(self, name)
            weights = real_array("Splitting", name, x, "a tuple of numbers")
            if weights.ndim != 1 or abs(weights.sum() - 1) > tables.TOLERANCE:
                raise InputError(f"Splitting: {name} is {shown(x)}, expected weights of sum 1")
        if len(self.kicks) - len(self.drifts) not in (0, 1):
            raise InputError(
                f"Splitting: got {len(self.kicks)} kicks and {len(self.drifts)} drifts, expected "
                "as many, or one kick more"
            )

    def order(self, terms):
        return self.formula_order

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        halves, h = Halves(terms, args), t1 - t0
        table = _kick_method(self.formula_order if self.velocity_forces else 1)
        drifts = np.pad(self.drifts, (0, len(self.kicks) - len(self.drifts)))
        times = np.concatenate([[0.0], np.cumsum(drifts)[:-1]])

        def part(y, weights):
            kick, drift, time = (w.astype(h.dtype) for w in weights)
            t = t0 + time * h
            (_, v), _ = split_pair(y)

            def rate(_, dv):
                return halves.acceleration(t, halves.kick(y, dv))

            zero = jax.tree.map(jnp.zeros_like, v)
            k = explicit_stages(rate, table, t, kick * h)(zero)
            y = halves.kick(y, scale(kick * h, combine(table.b, k)))
            drifted = halves.advance(y, scale(drift * h, halves.velocity(t, y)), zero)
            return select(drift == 0, y, drifted), None  # a zero drift would add rounding

        weights = tuple(map(jnp.asarray, (self.kicks, drifts, times)))
        y1, _ = jax.lax.scan(part, y0, weights)
        dense = dense_output(terms, args, t0, t1, y0, y1)
        return y1, None, dense, None, diffrax.RESULTS.successful


def _verlets(w: tuple[float, ...], order: int, velocity_forces: bool) -> Splitting:
    kicks = np.convolve(w, [0.5, 0.5])
    for power in range(3, order, 2):
        if abs(np.sum(np.power(w, power))) > tables.TOLERANCE:
            raise ValueError(f"splitting: the weights' sum of powers {power} is not zero")
    return Splitting(tuple(kicks.tolist()), w, order, velocity_forces)


def symplectic_euler(velocity_forces: bool = True) -> Splitting:
    """Return symplectic Euler: v1 = v0 + h a(t0, q0, v0), q1 = q0 + h v1, order 1.

    Args:
        velocity_forces: whether forces depend on the velocity; false saves work if they do not.

    Example:
        >>> import rbjax as rb
        >>> rb.solvers.symplectic_euler().order(None)
        1
    """
    return Splitting((1.0,), (1.0,), 1, velocity_forces)


def stoermer_verlet(velocity_forces: bool = True) -> Splitting:
    """Return the Stoermer-Verlet method: half a kick, a drift, half a kick; order 2, symmetric.

    Args:
        velocity_forces: whether forces depend on the velocity; false saves work if they do not.

    See `symplectic_euler` for an example.
    """
    return _verlets((1.0,), 2, velocity_forces)


def yoshida4(velocity_forces: bool = True) -> Splitting:
    """Return Yoshida's method of three Verlet steps, the middle one backwards: order 4.

    Args:
        velocity_forces: whether forces depend on the velocity; false saves work if they do not.

    See `symplectic_euler` for an example.
    """
    return _verlets(YOSHIDA4, 4, velocity_forces)


def yoshida6(velocity_forces: bool = True) -> Splitting:
    """Return Yoshida's method of seven Verlet steps (solution A): order 6.

    Args:
        velocity_forces: whether forces depend on the velocity; false saves work if they do not.

    See `symplectic_euler` for an example.
    """
    return _verlets(YOSHIDA6, 6, velocity_forces)
