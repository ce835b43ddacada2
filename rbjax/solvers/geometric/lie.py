"""Explicit Runge-Kutta methods on Lie groups: the state never leaves its group.

    Munthe-Kaas:       y = y0 exp(u), u' = xi + [u, xi] / 2 + [u, [u, xi]] / 12, u by Runge-Kutta
    Crouch-Grossman:   Y_i = y0 exp(a_i1 k_1) exp(a_i2 k_2) ...
    commutator-free:   products of exponentials of sums of the k_j
with k_j = h xi(t_j, Y_j), for y' = y xi. Dense output: y0 exp of a cubic, of order 4, on the group.
(Hairer, Lubich & Wanner, *Geometric Numerical Integration*, IV.8; Celledoni, Marthinsen & Owren,
*Future Generation Computer Systems* 19, 2003. Their equations have xi on the left: all products
are mirrored here.)
"""

from __future__ import annotations

from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import integer
from rbjax.solvers.common import tableau as tables
from rbjax.solvers.common.field import Field, field
from rbjax.solvers.common.groups import AbstractGroup, group_of
from rbjax.solvers.common.steps import (
    AbstractGroupSolver,
    combine,
    dense_between,
    explicit_stages,
    inverse_dexp,
    scaled,
)
from rbjax.solvers.common.tableau import Tableau

RESULTS = diffrax.RESULTS


class MuntheKaas(AbstractGroupSolver, diffrax.AbstractAdaptiveSolver):
    """RKMK with an explicit tableau of order at most 5; the error estimate is the tableau's."""

    tableau: Tableau = eqx.field(static=True)

    def order(self, terms):
        return self.tableau.order

    def error_order(self, terms):
        return self.tableau.error_order

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        group, f, h = group_of(terms), field(terms, args), t1 - t0

        def rate(t, u):
            return inverse_dexp(group, u, f(t, group.retract(y0, u)))

        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(f, t0, y0))
        k = explicit_stages(rate, self.tableau, t0, h)(zero)
        u = scaled(h, combine(self.tableau.b, k))
        y1, error = group.retract(y0, u), None
        if self.tableau.error:
            other = combine((1.0, -h), (u, combine(self.tableau.error[1:], k)))
            error = jax.tree.map(lambda a, b: a - b, y1, group.retract(y0, other))
        return y1, error, dense_between(group, f, t0, t1, y0, y1), None, RESULTS.successful


def rkmk(order: int) -> MuntheKaas:
    """Munthe-Kaas' method on Heun's (2), Bogacki and Shampine's (3), the classical (4) or Dormand
    and Prince's method (5).

    Raises:
        InputError: another order.
    """
    integer("rkmk", "order", order, least=2, most=5)
    table = {
        2: tables.HEUN,
        3: tables.of_diffrax(diffrax.Bosh3, 3),
        4: tables.RK4,
        5: tables.of_diffrax(diffrax.Dopri5, 5),
    }
    return MuntheKaas(table[order])


class CrouchGrossman3(AbstractGroupSolver):
    """Crouch and Grossman's method of three stages: order 3, constant steps."""

    def order(self, terms):
        return 3

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        group, f, h = group_of(terms), field(terms, args), t1 - t0
        a21, a31, a32 = 3 / 4, 119 / 216, 17 / 108
        b = (13 / 51, -2 / 3, 24 / 17)
        k1 = scaled(h, f(t0, y0))
        k2 = scaled(h, f(t0 + a21 * h, _product(group, y0, (a21,), (k1,))))
        k3 = scaled(h, f(t0 + (a31 + a32) * h, _product(group, y0, (a31, a32), (k1, k2))))
        y1 = _product(group, y0, b, (k1, k2, k3))
        return y1, None, dense_between(group, f, t0, t1, y0, y1), None, RESULTS.successful


class CommutatorFree4(AbstractGroupSolver):
    """Celledoni, Marthinsen and Owren's method of five exponentials: order 4, constant steps."""

    def order(self, terms):
        return 4

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        group, f, h = group_of(terms), field(terms, args), t1 - t0
        y1 = self._advanced(group, f, t0, h, y0)
        return y1, None, dense_between(group, f, t0, t1, y0, y1), None, RESULTS.successful

    def _advanced(self, group: AbstractGroup, f: Field, t0: Any, h: Any, y0: Any) -> Any:
        k1 = scaled(h, f(t0, y0))
        second = group.retract(y0, scaled(1 / 2, k1))
        k2 = scaled(h, f(t0 + h / 2, second))
        k3 = scaled(h, f(t0 + h / 2, group.retract(y0, scaled(1 / 2, k2))))
        fourth = group.retract(second, combine((1.0, -1 / 2), (k3, k1)))
        k4 = scaled(h, f(t0 + h, fourth))
        ks = (k1, k2, k3, k4)
        half = group.retract(y0, combine((1 / 4, 1 / 6, 1 / 6, -1 / 12), ks))
        return group.retract(half, combine((-1 / 12, 1 / 6, 1 / 6, 1 / 4), ks))


def _product(group: AbstractGroup, y: Any, weights: tuple[float, ...], ks: tuple) -> Any:
    """y exp(w_1 k_1) exp(w_2 k_2) ..."""
    for w, k in zip(weights, ks, strict=True):
        y = group.retract(y, scaled(w, k))
    return y
