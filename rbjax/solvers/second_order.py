"""Methods for q' = v, v' = a(t, q, v): Newmark's family, semi-implicit Euler, variational midpoint.

The state is a pair (q, v) with rate (v, a). On a Lie group (`OnGroup`), q + u means q exp(u).
Newmark's family stores an acceleration A between steps:

    q1 = q0 + h v0 + h^2 ((1/2 - beta) A0 + beta A1)
    v1 = v0 + h ((1 - gamma) A0 + gamma A1)
    (1 - alpha_m) A1 + alpha_m A0 = (1 - alpha_f) a1 + alpha_f a0,    a1 = a(t1, q1, v1)
The dense output is a cubic. There is no error estimate: use constant steps, or
`diffrax.HalfSolver`, which compares a step with two half steps.

Source: Newmark 1959; Hilber, Hughes & Taylor 1977; Chung & Hulbert 1993; Arnold & Bruels,
*Multibody System Dynamics* 18, 2007.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import optimistix as optx

from rbjax.arguments import real_number
from rbjax.lanes.arrays import select
from rbjax.solvers.field import SolverField, time_direction
from rbjax.solvers.groups import group_of, unwrap
from rbjax.solvers.root_finding import MAX_STEPS, chord, root, step_result
from rbjax.solvers.steps import (
    AbstractGroupSolver,
    combine,
    dense_output,
    scale,
    split_pair,
)

RESULTS = diffrax.RESULTS
ROUNDING = 1e-6  # rounding error of the parameters in single precision


class Halves(eqx.Module):
    """A term whose state is a pair (q, v), with access to the halves of its rate and state."""

    terms: Any
    args: Any

    def rate(self, t: Any, y: Any) -> Any:
        return SolverField(self.terms, self.args)(t, y)

    def acceleration(self, t: Any, y: Any) -> Any:
        return split_pair(self.rate(t, y))[0][1]

    def velocity(self, t: Any, y: Any) -> Any:
        return split_pair(self.rate(t, y))[0][0]

    def kick(self, y: Any, dv: Any) -> Any:
        """Return the state with dv added to v."""
        (q, v), together = split_pair(y)
        return together([q, combine((1.0, 1.0), (v, dv))])

    def advance(self, y: Any, dq: Any, dv: Any) -> Any:
        """Return the state with dq added to q, on its group, and dv added to v."""
        _, together = split_pair(y)
        return group_of(self.terms).retract(y, together([dq, dv]))


def momentum_function(terms: Any, args: Any) -> Callable[[Any, Any], Any] | None:
    """Return the momentum function (t, y) -> p of a term, with t in the solver's time, or None."""
    of_term = getattr(unwrap(terms), "momentum", None)
    return of_term and (lambda t, y: of_term(time_direction(terms, t) * t, y, args))


def multiply_by_mass(
    momentum: Callable[[Any, Any], Any],
    place: Callable[[Any], Any],
    residual: Callable[[Any], Any],
    guess: Any,
) -> tuple[Callable[[Any], Any], Callable[[Any, Any], Any]]:
    """Multiply the residual of an equation of accelerations by the mass matrix. The first returned
    function uses the mass matrix at the guess, the second one at place(k). Newton's method on the
    second one converges from farther away, because the force of a stiff spring is linear in q, and
    M(q)^-1 times this force is not."""
    held = jax.lax.stop_gradient(place(guess))
    _, inertia = jax.linearize(lambda v: momentum(held, v), guess)

    def weighted(k):
        return inertia(residual(k))

    def at_new_position(k, _):
        return momentum(place(k), residual(k)), None

    return weighted, at_new_position


class GeneralizedAlpha(AbstractGroupSolver):
    """Implicit members of Newmark's family.

    The order is 2 if gamma = 1/2 - alpha_m + alpha_f, and 1 otherwise.

    Fields: alpha_m, alpha_f, beta, gamma; root_finder, root_find_max_steps.
    """

    alpha_m: float
    alpha_f: float
    beta: float
    gamma: float
    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    def order(self, terms):
        """Return the order of the method, or 1 if the parameters are traced."""
        off: Any = self.gamma - (1 / 2 - self.alpha_m + self.alpha_f)
        return 2 if not isinstance(off, jax.core.Tracer) and abs(off) < ROUNDING else 1

    def init(self, terms, t0, t1, y0, args):
        # A, and whether the next step must first set it to the acceleration, as after a jump
        return split_pair(_no_rate(terms, args, t0, y0))[0][1], jnp.array(True)

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        halves, h = Halves(terms, args), t1 - t0
        (_, v0), _ = split_pair(y0)
        rate0 = halves.rate(t0, y0)
        (velocity, now), together = split_pair(rate0)
        carried, begins = solver_state
        carried = select(begins | made_jump, now, carried)
        m, f = self.alpha_m, self.alpha_f
        bent = time_direction(terms, h) * h  # q'' is v' times the direction of time

        def after(k):
            """Compute h A1, with A the stored acceleration, and the next state, for k = h a1."""
            old = scale(h, carried)
            carrying = combine(
                ((1 - f) / (1 - m), f / (1 - m), -m / (1 - m)), (k, scale(h, now), old)
            )  # h A1
            dq = combine((h, bent * (0.5 - self.beta), bent * self.beta), (velocity, old, carrying))
            dv = combine((1 - self.gamma, self.gamma), (old, carrying))
            return carrying, halves.advance(y0, dq, dv)

        def residual(k):
            return combine((1.0, -h), (k, halves.acceleration(t1, after(k)[1])))

        # The guess extrapolates q at v0, because the acceleration of a stiff spring leads far away.
        explicit = self.beta == 0
        free = jnp.where(explicit, 0.0, (self.beta - 0.5) / jnp.where(explicit, 1.0, self.beta))
        guess = combine(
            (((1 - m) * free + m) / (1 - f), -f / (1 - f)), (scale(h, carried), scale(h, now))
        )
        function, slope, momentum = residual, None, momentum_function(terms, args)
        if momentum is not None:
            of_state = split_pair(y0)[1]
            function, slope = multiply_by_mass(
                lambda q, v: momentum(t1, of_state([q, v])),
                lambda k: split_pair(after(k)[1])[0][0], residual, guess,
            )  # fmt: skip
        max_steps = self.root_find_max_steps
        k, ok = root(function, self.root_finder, guess, v0, max_steps, slope=slope)
        carrying, y1 = after(k)
        per_step = 1 / jnp.where(h == 0, 1.0, h)
        a1, carried = (
            select(h == 0, old, scale(per_step, x)) for x, old in ((k, now), (carrying, carried))
        )
        rate1 = together([halves.velocity(t1, y1), a1])
        dense = dense_output(terms, args, t0, t1, y0, y1, rate0, rate1)
        return y1, None, dense, (carried, jnp.array(False)), step_result(ok)


def _no_rate(terms: Any, args: Any, t: Any, y: Any) -> Any:
    """Return zeros with the shapes of the rate."""
    rate = jax.eval_shape(SolverField(terms, args), t, y)
    return jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), rate)


def generalized_alpha(rho_inf: float = 0.9, **options: Any) -> GeneralizedAlpha:
    """Return Chung and Hulbert's generalized-alpha method of order 2.

    Args:
        rho_inf: spectral radius at infinite frequency, from 0 to 1.
        options: fields of `GeneralizedAlpha`.

    Raises:
        InputError: rho_inf out of its range.

    Example:
        >>> import rbjax as rb
        >>> rb.solvers.generalized_alpha(0.5).order(None)
        2
    """
    real_number("generalized_alpha", "rho_inf", rho_inf, least=0, most=1, traced=True)
    m, f = (2 * rho_inf - 1) / (rho_inf + 1), rho_inf / (rho_inf + 1)
    return GeneralizedAlpha(m, f, (1 - m + f) ** 2 / 4, 1 / 2 - m + f, **options)


def newmark(beta: float = 0.25, gamma: float = 0.5, **options: Any) -> GeneralizedAlpha:
    """Return Newmark's method.

    The order is 2 if gamma is 1/2. A larger gamma damps. With beta 1/4 it is the average
    acceleration method, which is A-stable.

    Args:
        beta: weight of the new acceleration in the position, not negative.
        gamma: weight of the new acceleration in the velocity, at least 1/2.
        options: fields of `GeneralizedAlpha`.

    Raises:
        InputError: beta or gamma out of its range.

    See `generalized_alpha` for an example.
    """
    real_number("newmark", "beta", beta, least=0, traced=True)
    real_number("newmark", "gamma", gamma, least=0.5, traced=True)  # below, oscillations grow
    return GeneralizedAlpha(0.0, 0.0, beta, gamma, **options)


def hht_alpha(alpha: float = -0.1, **options: Any) -> GeneralizedAlpha:
    """Return the method of Hilber, Hughes and Taylor: order 2, A-stable.

    Args:
        alpha: from -1/3, with the most damping, to 0.
        options: fields of `GeneralizedAlpha`.

    Raises:
        InputError: alpha out of its range.

    See `generalized_alpha` for an example.
    """
    real_number("hht_alpha", "alpha", alpha, least=-1 / 3, most=0, traced=True)
    return GeneralizedAlpha(0.0, -alpha, (1 - alpha) ** 2 / 4, 1 / 2 - alpha, **options)


class CentralDifferences(AbstractGroupSolver):
    """Newmark's explicit member (beta 0, gamma 1/2): order 2, stable up to h omega = 2. Forces that
    depend on the velocity are evaluated at v0 + h a0, so the method stays explicit and of order
    2."""

    def order(self, terms):
        return 2

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        halves, h = Halves(terms, args), t1 - t0
        rate0 = halves.rate(t0, y0)
        (v, a0), _ = split_pair(rate0)
        dq = combine((h, time_direction(terms, h) * h * h / 2), (v, a0))
        a1 = halves.acceleration(t1, halves.advance(y0, dq, scale(h, a0)))
        y1 = halves.advance(y0, dq, combine((h / 2, h / 2), (a0, a1)))
        dense = dense_output(terms, args, t0, t1, y0, y1, rate0)
        return y1, None, dense, None, RESULTS.successful


class SemiImplicitEuler(AbstractGroupSolver):
    """Semi-implicit Euler with implicit damping, the default of robot simulators: order 1.

        (1 - h da/dv) (v1 - v0) = h a(t0, q0, v0),    q1 = q0 + h v1
    Damping does not limit the step. da/dv includes Coriolis forces and servo gains. `linear_solver`
    is a lineax solver; `lineax.GMRES` needs no matrix.
    """

    linear_solver: lx.AbstractLinearSolver = eqx.field(default_factory=lx.LU)

    def order(self, terms):
        return 1

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        halves, h = Halves(terms, args), t1 - t0
        (q0, v0), together = split_pair(y0)
        a0, slope = jax.linearize(lambda v: halves.acceleration(t0, together([q0, v])), v0)
        operator = lx.FunctionLinearOperator(
            lambda dv: combine((1.0, -h), (dv, slope(dv))), jax.eval_shape(lambda: v0)
        )
        solved = lx.linear_solve(operator, scale(h, a0), self.linear_solver, throw=False)
        dv = solved.value
        after = halves.kick(y0, dv)
        y1 = halves.advance(after, scale(h, halves.velocity(t0, after)), scale(0.0, dv))
        dense = dense_output(terms, args, t0, t1, y0, y1)
        return y1, None, dense, None, step_result(solved.result == lx.RESULTS.successful)


class VariationalMidpoint(AbstractGroupSolver):
    """Variational midpoint rule: discrete Euler-Lagrange equations of L_d = h L(q0 + h w / 2, w).

        q1 = q0 + h w,  p1 - p0 = h p'(m),  (p0 + p1) / 2 = p(m),  m = (q0 + h w / 2, w)
    p = M(q) v. The method is exactly symplectic in (q, p), and of order 2 with any forces. The term
    provides the momentum (`OnGroup(..., momentum=)`). Without it the mass is constant, p is v, and
    the method is the implicit midpoint rule. (Marsden & West, *Acta Numerica* 2001.)

    Fields: root_finder, root_find_max_steps.
    """

    root_finder: optx.AbstractRootFinder = eqx.field(default_factory=chord)
    root_find_max_steps: int = MAX_STEPS

    def order(self, terms):
        return 2

    def step(self, terms, t0, t1, y0, args, solver_state, made_jump):
        halves, h = Halves(terms, args), t1 - t0
        (_, v0), _ = split_pair(y0)
        tm = t0 + h / 2
        momentum = momentum_function(terms, args) or (lambda t, y: split_pair(y)[0][1])
        p0 = momentum(t0, y0)

        def middle(dw):
            """Return the mean velocity of the step and its middle state, if v changes by dw."""
            w = halves.velocity(tm, halves.kick(y0, dw))
            return w, halves.advance(y0, scale(h / 2, w), dw)

        def residual(dw):
            w, at = middle(dw)
            a = halves.acceleration(tm, at)

            def onward(s):
                return momentum(tm + s, halves.advance(at, scale(s, w), scale(s, a)))

            p, rate = jax.jvp(onward, (h * 0,), (h * 0 + 1,))
            return combine((1.0, -1.0, -h / 2), (p, p0, rate))

        guess = jax.tree.map(jnp.zeros_like, v0)
        dw, ok = root(residual, self.root_finder, guess, v0, self.root_find_max_steps)
        w, at = middle(dw)
        p1 = combine((2.0, -1.0), (momentum(tm, at), p0))
        there = halves.advance(y0, scale(h, w), scale(2.0, dw))
        (_, v), _ = split_pair(there)
        t1 = t0 + h

        def moment(dv):
            return momentum(t1, halves.kick(there, dv))

        here, linear = jax.linearize(moment, jax.tree.map(jnp.zeros_like, v))
        operator = lx.FunctionLinearOperator(linear, jax.eval_shape(lambda: v))
        missing = combine((1.0, -1.0), (p1, here))
        solved = lx.linear_solve(operator, missing, lx.LU(), throw=False)
        y1 = halves.kick(there, solved.value)
        dense = dense_output(terms, args, t0, t1, y0, y1)
        return y1, None, dense, None, step_result(ok & (solved.result == lx.RESULTS.successful))
