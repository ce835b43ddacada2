"""Explicit Runge-Kutta methods on Lie groups. The state stays on its group.

    Munthe-Kaas:       y = y0 exp(u), u' = xi + [u, xi] / 2 + [u, [u, xi]] / 12, u by Runge-Kutta
    Crouch-Grossman:   Y_i = y0 exp(a_i1 k_1) exp(a_i2 k_2) ...
    commutator-free:   products of exponentials of sums of the k_j
with k_j = h xi(t_j, Y_j), for y' = y xi. The dense output is y0 times the exponential of a cubic,
of order 4. The sources have xi on the left, and their products are in the opposite order.

`RigidBodySplitting` integrates the rigid body q' = q (0, w) / 2, J w' = J w x w + torque(t, q). Its
kinetic energy is the sum of three terms m_i^2 / 2 J_i with m = J w. The flow of one term rotates
the body about its axis i at the constant rate m_i / J_i. The symmetric product
X(h/2) Y(h/2) Z(h) Y(h/2) X(h/2) is symplectic, of order 2, and conserves the angular momentum in
space. A torque changes m before and after the product.

Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, IV.8 and VII.5.3; Celledoni,
Marthinsen & Owren, *Future Generation Computer Systems* 19, 2003; McLachlan 1993.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.errors import InputError
from rbjax.solvers import tableau as tables
from rbjax.solvers.field import SolverField, time_direction
from rbjax.solvers.groups import SO3, AbstractGroup, OnGroup, Product, Vector, group_of, unwrap
from rbjax.solvers.steps import (
    AbstractGroupSolver,
    combine,
    dense_output,
    explicit_stages,
    inverse_dexp,
    scale,
)
from rbjax.solvers.tableau import Tableau

RESULTS = diffrax.RESULTS


class MuntheKaas(AbstractGroupSolver, diffrax.AbstractAdaptiveSolver):
    """The Munthe-Kaas method of an explicit tableau of order at most 5."""

    tableau: Tableau = eqx.field(static=True)

    def order(self, terms):
        return self.tableau.order

    def error_order(self, terms):
        return self.tableau.error_order

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        group, f, h = group_of(terms), SolverField(terms, args), t1 - t0

        def rate(t, u):
            return inverse_dexp(group, u, f(t, group.retract(y0, u)))

        zero = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(f, t0, y0))
        k = explicit_stages(rate, self.tableau, t0, h)(zero)
        u = scale(h, combine(self.tableau.b, k))
        y1, error = group.retract(y0, u), None
        if self.tableau.error:
            other = combine((1.0, -h), (u, combine(self.tableau.error[1:], k)))
            error = jax.tree.map(lambda a, b: a - b, y1, group.retract(y0, other))
        return y1, error, dense_output(terms, args, t0, t1, y0, y1), None, RESULTS.successful


def rkmk(order: int) -> MuntheKaas:
    """Return the Munthe-Kaas method of order 2 to 5.

    The tableaus are Heun's (2), Bogacki-Shampine (3), the classical one (4) and Dormand-Prince (5).

    Args:
        order: 2 to 5.

    Raises:
        InputError: another order.

    Example:
        >>> import rbjax as rb
        >>> rb.solvers.rkmk(4).order(None)
        4
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
        group, f, h = group_of(terms), SolverField(terms, args), t1 - t0
        a21, a31, a32 = 3 / 4, 119 / 216, 17 / 108
        b = (13 / 51, -2 / 3, 24 / 17)
        k1 = scale(h, f(t0, y0))
        k2 = scale(h, f(t0 + a21 * h, _product(group, y0, (a21,), (k1,))))
        k3 = scale(h, f(t0 + (a31 + a32) * h, _product(group, y0, (a31, a32), (k1, k2))))
        y1 = _product(group, y0, b, (k1, k2, k3))
        return y1, None, dense_output(terms, args, t0, t1, y0, y1), None, RESULTS.successful


class CommutatorFree4(AbstractGroupSolver):
    """Celledoni, Marthinsen and Owren's method of five exponentials: order 4, constant steps."""

    def order(self, terms):
        return 4

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        group, f, h = group_of(terms), SolverField(terms, args), t1 - t0
        k1 = scale(h, f(t0, y0))
        second = group.retract(y0, scale(1 / 2, k1))
        k2 = scale(h, f(t0 + h / 2, second))
        k3 = scale(h, f(t0 + h / 2, group.retract(y0, scale(1 / 2, k2))))
        fourth = group.retract(second, combine((1.0, -1 / 2), (k3, k1)))
        k4 = scale(h, f(t0 + h, fourth))
        ks = (k1, k2, k3, k4)
        half = group.retract(y0, combine((1 / 4, 1 / 6, 1 / 6, -1 / 12), ks))
        y1 = group.retract(half, combine((-1 / 12, 1 / 6, 1 / 6, 1 / 4), ks))
        return y1, None, dense_output(terms, args, t0, t1, y0, y1), None, RESULTS.successful


def _product(group: AbstractGroup, y: Any, weights: tuple[float, ...], ks: tuple) -> Any:
    """Return y exp(w_1 k_1) exp(w_2 k_2) ..."""
    for w, k in zip(weights, ks, strict=True):
        y = group.retract(y, scale(w, k))
    return y


class RigidBody(OnGroup):
    """Euler's equations of a body about its centre of mass or a fixed point, as a term on a group.

    The state is (quaternion (4,), angular velocity (3,) in body axes).

    Args:
        inertia: (3,) principal moments, kg m^2, along the body axes.
        torque: (t, quaternion, args) -> (3,) N m in body axes, or None.

    Raises:
        InputError: the inertia has another shape, or is not positive.

    Example:
        >>> import rbjax as rb
        >>> rb.solvers.RigidBody([1.0, 2.0, 3.0]).inertia.tolist()
        [1.0, 2.0, 3.0]
    """

    inertia: jax.Array  # type: ignore[misc]
    torque: Callable[..., jax.Array] | None  # type: ignore[misc]

    def __init__(self, inertia: Any, torque: Callable[..., jax.Array] | None = None):
        self.inertia = jnp.asarray(inertia)
        if self.inertia.shape != (3,):
            raise InputError(
                f"RigidBody: inertia has shape {self.inertia.shape}, expected (3,): the principal "
                "moments, along the body axes"
            )
        known = not isinstance(self.inertia, jax.core.Tracer)
        if known and not (np.asarray(self.inertia) > 0).all():
            raise InputError(f"RigidBody: inertia {self.inertia}, expected positive moments")
        self.torque = torque
        self.group: AbstractGroup = Product((SO3(), Vector()))
        self.vector_field = _no_field
        self.momentum = None

    def vf(self, t, y, args):
        turn, w = y
        m = self.inertia * w
        moment = jnp.cross(m, w) + self.moment(t, turn, args)
        return w, moment / self.inertia

    def moment(self, t, turn, args):
        """Return the torque (3,), N m in body axes."""
        return jnp.zeros(3, turn.dtype) if self.torque is None else self.torque(t, turn, args)


def _no_field(t, y, args):
    raise TypeError("RigidBody has its own equations")


class RigidBodySplitting(AbstractGroupSolver):
    """Splitting of a `RigidBody` into exact rotations about its three axes: order 2."""

    term_structure: ClassVar[Any] = RigidBody

    def order(self, terms):
        return 2

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        body, h = unwrap(terms), terms.contr(t0, t1)
        inertia = body.inertia
        ahead = time_direction(terms, t0)
        turn, w = y0
        m = inertia * w + h / 2 * body.moment(ahead * t0, turn, args)
        for axis, share in ((0, 0.5), (1, 0.5), (2, 1.0), (1, 0.5), (0, 0.5)):
            angle = share * h * m[axis] / inertia[axis]
            turn = SO3().retract(turn, jnp.zeros(3, m.dtype).at[axis].set(angle))
            m = _rotate_axes(m, axis, angle)
        m = m + h / 2 * body.moment(ahead * t1, turn, args)
        y1 = (turn, m / inertia)
        dense = dense_output(terms, args, t0, t1, y0, y1)
        return y1, None, dense, None, diffrax.RESULTS.successful


def _rotate_axes(m: jax.Array, axis: int, angle: jax.Array) -> jax.Array:
    """Return m in axes that are rotated by an angle about one of them. The change is added: a
    cosine near 1 would be rounded in the same direction at each step, so m would grow or shrink."""
    i, j = (axis + 1) % 3, (axis + 2) % 3
    versine, s = 2 * jnp.sin(angle / 2) ** 2, jnp.sin(angle)
    return m.at[i].add(s * m[j] - versine * m[i]).at[j].add(-s * m[i] - versine * m[j])
