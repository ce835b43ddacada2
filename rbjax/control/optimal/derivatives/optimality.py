"""The optimality conditions of a problem, and the linear system of the derivative of an optimum.

    L = sum_k L_k(x_k, u_k) + l_{k+1}.(f(x_k, u_k) - x_{k+1}) + nu_k.(c_k - b_k)
        + L_N(x_N) + nu_N.(c_N - b_N) + l_0.(start - x_0)

At an optimum, the gradient of L with respect to the unknowns z = (x, u, l, nu) is zero. Its Hessian
is K. x are tangent coordinates at each knot. A control at an active bound moves with the bound.
Inequalities with a nonzero multiplier are active (strict complementarity). If K does not belong to
a minimum, regularised Gauss-Newton Hessians replace the exact ones.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.flatten_util import ravel_pytree

from rbjax.control.optimal.derivatives.riccati_solve import (
    KKTFactor,
    KKTUnknowns,
    Saddle,
    apply_masks,
    factorise,
    multiply,
    solve,
    transpose_product,
)
from rbjax.control.optimal.problem import BODY, NEXT, Knot, take
from rbjax.control.products import product
from rbjax.lanes.arrays import select

BOUND_ROUNDING = 64.0  # tolerance of active bounds, in units in the last place
REGULAR = 1e-6  # regularisation of Gauss-Newton Hessians, relative to the mean of the diagonal
POLISH = 1  # Newton steps at the solution, which has a finite tolerance


class KnotValues(NamedTuple):
    """The functions of a problem at a knot (+) d.

    r: residuals.
    rest: sum of the costs that are numbers, ().
    after: state after the step minus the next knot, (n,).
    c, low, high: constraints and their bounds.
    """

    r: jax.Array
    rest: jax.Array
    after: jax.Array
    c: jax.Array
    low: jax.Array
    high: jax.Array


class Functions(NamedTuple):
    """The functions of a problem. Their first arguments are the closed-over tracers and the arrays
    of the problem.

    run: the search.
    path, end: functions that return the `KnotValues` of a knot.
    """

    run: Callable[..., Any]
    path: Callable[..., KnotValues]
    end: Callable[..., KnotValues]


class PrimalDualPoint(NamedTuple):
    """The point at which an optimum is differentiated: knots, controls and multipliers."""

    knots: Knot
    ctrl: jax.Array
    path: jax.Array
    end: jax.Array


class KKTPoint(NamedTuple):
    """The KKT system at a point: active bounds, gradient of L, matrix and factors."""

    point: PrimalDualPoint
    l: jax.Array
    at_low: jax.Array
    at_high: jax.Array
    first_low: jax.Array
    first_high: jax.Array
    gradient: KKTUnknowns
    equations: Saddle
    factor: KKTFactor


def solve_kkt(kkt: KKTPoint, r: KKTUnknowns) -> KKTUnknowns:
    """Solve the KKT system K z = r for the unknowns z."""
    e, f = kkt.equations, kkt.factor
    flat, whole = ravel_pytree(r)  # one array, as the transpose rule needs

    def matrix(z: jax.Array) -> jax.Array:
        return ravel_pytree(multiply(e, whole(z)))[0]

    def inverse(_: Any, r: jax.Array) -> jax.Array:
        return ravel_pytree(solve(e, f, whole(r)))[0]

    return whole(jax.lax.custom_linear_solve(matrix, flat, inverse, symmetric=True))


class KKTSystem:
    """The KKT conditions of a problem, as functions of its parameters."""

    def __init__(self, functions: Functions, whole: Callable, parameters: tuple) -> None:
        self.functions, self.whole, self.parameters = functions, whole, parameters
        self.problem = whole(parameters[1])
        self.n, self.m = self.problem.n, self.problem.nu

    # a knot

    def path(self, parameters: tuple, d: jax.Array, *knot: Any) -> KnotValues:
        return self.functions.path(parameters[0], parameters[1], d, *knot)

    def end(self, parameters: tuple, d: jax.Array, knot: Knot) -> KnotValues:
        return self.functions.end(parameters[0], parameters[1], d, knot)

    def knots(self, point: PrimalDualPoint) -> tuple:
        """Return (k, knot, control, next knot) at all knots with controls, and the last knot."""
        ks = jnp.arange(self.problem.horizon, dtype=point.ctrl.dtype)
        body, following, last = (take(point.knots, at) for at in (BODY, NEXT, -1))
        return (ks, body, point.ctrl, following), last

    # the equations

    def polished(self, point: PrimalDualPoint, wanted: jax.Array) -> KKTPoint:
        """Return the KKT system after Newton steps, if `wanted` and if they reduce the gradient."""
        like = jax.eval_shape(self.at, point)
        best = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), like)

        def turn(k: Any, now: tuple[PrimalDualPoint, KKTPoint]) -> tuple[PrimalDualPoint, KKTPoint]:
            point, best = now
            kkt = self.at(point)
            better = wanted & (_size(kkt.gradient) < _size(best.gradient))
            best = select((k == 0) | better, kkt, best)
            z = solve_kkt(best, jax.tree.map(jnp.negative, best.gradient))
            at = best.point
            knots = jax.vmap(self.problem.plus)(at.knots, z.x)
            ctrls = self.controls(self.parameters, best) + z.u
            return PrimalDualPoint(knots, ctrls, at.path + z.path, at.end + z.end), best

        return jax.lax.fori_loop(0, POLISH + 1, turn, (point, best))[1]

    def at(self, point: PrimalDualPoint) -> KKTPoint:
        """Evaluate the KKT system at a point."""
        n, m, dtype, system = self.n, self.m, point.ctrl.dtype, self.problem.system
        at, last = self.knots(point)

        def first(d: jax.Array, values: Callable[[jax.Array], KnotValues], nu: jax.Array) -> tuple:
            def flat(d: jax.Array) -> tuple:
                s = values(d)
                return (s.after, s.c, s.r, _cost(s) + (nu * s.c).sum()), s

            (F, G, J, g), s = jax.jacfwd(flat, has_aux=True)(d)
            return F, G, g, _gauss_newton(J), s.after, _active_residual(s, nu), s.low == s.high

        def of_path(nu: jax.Array, *knot: Any) -> tuple:
            values = lambda d: self.path(self.parameters, d, *knot)  # noqa: E731
            return first(jnp.zeros(n + m, dtype), values, nu)

        F, G, g, gauss, gap, off, equal = jax.vmap(of_path)(point.path, *at)
        seen_end = functools.partial(self.end, self.parameters, knot=last)
        _, E, l_N, gauss_N, _, off_N, equal_N = first(jnp.zeros(n, dtype), seen_end, point.end)

        def back(l: jax.Array, x: tuple) -> tuple:
            F, g = x
            g = g + product(F.T, l)
            return g[:n], (l, g[n:])

        swept: tuple = jax.lax.scan(back, l_N, (F, g), reverse=True)
        l_0, (l, gu) = swept
        l = jnp.concatenate([l_0[None], l])

        at_low, at_high = _active_bounds(point.ctrl, *self._bounds(self.parameters), gu)
        parameters = point.knots.parameters[0]
        first_bounds = self._first_bounds(self.parameters)
        first_low, first_high = _active_bounds(parameters, *first_bounds, l_0[system.n :])
        held = [~jnp.asarray(self.problem.free, bool), first_low | first_high]
        holds = (
            jnp.concatenate(held), ~(at_low | at_high), (point.path != 0) | equal,
            (point.end != 0) | equal_N,
        )  # fmt: skip
        masks = tuple(x.astype(dtype) for x in holds)
        fixed, free, rows, rows_N = masks

        def L(values: Callable[[jax.Array], KnotValues], l: jax.Array, nu: jax.Array) -> Callable:
            def value(d: jax.Array) -> jax.Array:
                s = values(d)
                return _cost(s) + (l * s.after).sum() + (nu * s.c).sum()

            return jax.jacfwd(jax.grad(value))

        def second(l: jax.Array, nu: jax.Array, *knot: Any) -> jax.Array:
            values = lambda d: self.path(self.parameters, d, *knot)  # noqa: E731
            return L(values, l, nu)(jnp.zeros(n + m, dtype))

        H = jax.vmap(second)(l[1:], point.path, *at)
        H_N = L(seen_end, jnp.zeros(0, dtype), point.end)(jnp.zeros(n, dtype))

        def made(H: jax.Array, H_N: jax.Array) -> Saddle:
            Q = jnp.concatenate([H[:, :n, :n], H_N[None]])
            jacobians = F[:, :, :n], F[:, :, n:], G[:, :, :n], G[:, :, n:], E
            A, B, C, D, end = jacobians
            return apply_masks(Saddle(A, B, Q, H[:, :n, n:], H[:, n:, n:], C, D, end, *masks))

        e, factor = _definite_equations(made(H, H_N), made(gauss, gauss_N))
        first_row = (1 - fixed) * l_0
        gradient = KKTUnknowns(
            jnp.zeros_like(l).at[0].set(first_row), free * gu,
            jnp.concatenate([jnp.zeros((1, n), dtype), gap]), rows * off, rows_N * off_N,
        )  # fmt: skip
        kept = (at_low, at_high, first_low, first_high)
        kkt = KKTPoint(point, l.at[0].multiply(fixed), *kept, gradient, e, factor)
        first_row = self.first_row(self.parameters, kkt)
        return kkt._replace(gradient=gradient._replace(l=gradient.l.at[0].set(first_row)))

    def _bounds(self, parameters: tuple) -> tuple[jax.Array, jax.Array]:
        problem = self.whole(parameters[1])
        dtype = problem.dt.dtype
        if not problem.bounded:
            return jnp.full(self.m, -jnp.inf, dtype), jnp.full(self.m, jnp.inf, dtype)
        return problem.low.astype(dtype), problem.high.astype(dtype)

    def _first_bounds(self, parameters: tuple) -> tuple[jax.Array, jax.Array]:
        problem = self.whole(parameters[1])
        return problem.parameter_bounds(problem.dt.dtype)

    # L as a function of the parameters

    def controls(self, parameters: tuple, kkt: KKTPoint) -> jax.Array:
        """Return the controls, with entries at an active bound replaced by the bound."""
        low, high = self._bounds(parameters)
        u = jnp.where(kkt.at_low, low, kkt.point.ctrl)
        return jnp.where(kkt.at_high, high, u)

    def first_row(self, parameters: tuple, kkt: KKTPoint) -> jax.Array:
        """Return the residual of the fixed coordinates of the first knot."""
        system = self.whole(parameters[1]).system
        first = take(kkt.point.knots, 0)
        low, high = self._first_bounds(parameters)
        held = jnp.where(kkt.first_low, low, jnp.where(kkt.first_high, high, first.parameters))
        off = [system.minus(parameters[2], first.state), held - first.parameters]
        return kkt.equations.fixed * jnp.concatenate(off)

    def gradient(self, parameters: tuple, kkt: KKTPoint) -> KKTUnknowns:
        """Return the gradient of L with respect to the unknowns."""
        zero = jax.tree.map(jnp.zeros_like, kkt.gradient)
        g = jax.grad(lambda z: self.lagrangian(parameters, kkt, z))(zero)
        e = kkt.equations
        return g._replace(u=e.free * g.u, path=e.path * g.path, end=e.end * g.end)

    def lagrangian(
        self, parameters: tuple, kkt: KKTPoint, z: KKTUnknowns | None = None
    ) -> jax.Array:
        """Return the Lagrangian at the point (+) z, with active constraint rows only."""
        point, z = kkt.point, jax.tree.map(jnp.zeros_like, kkt.gradient) if z is None else z
        (ks, body, _, following), last = self.knots(point)

        def one(l: jax.Array, nu: jax.Array, d: jax.Array, after: jax.Array, *knot: Any) -> Any:
            s = self.path(parameters, d, *knot)
            return _cost(s) + (l * (s.after - after)).sum() + (nu * _active_residual(s, nu)).sum()

        l, nu, nu_N = kkt.l + z.l, point.path + z.path, point.end + z.end
        d = jnp.concatenate([z.x[:-1], z.u], 1)
        at = (ks, body, self.controls(parameters, kkt), following)
        s = self.end(parameters, z.x[-1], last)
        closing = _cost(s) + (nu_N * _active_residual(s, nu_N)).sum()
        first_row = self.first_row(parameters, kkt) - kkt.equations.fixed * z.x[0]
        return jax.vmap(one)(l[1:], nu, d, z.x[1:], *at).sum() + closing + (l[0] * first_row).sum()


def _definite_equations(exact: Saddle, gauss: Saddle) -> tuple[Saddle, KKTFactor]:
    """Return the system with exact Hessians if definite, else with Gauss-Newton Hessians."""
    fixed = jax.lax.stop_gradient
    found = factorise(fixed(exact))
    e = select(found.ok, exact, gauss)
    return e, jax.lax.cond(found.ok, lambda: found, lambda: factorise(fixed(gauss)))


def _cost(s: KnotValues) -> jax.Array:
    return 0.5 * (s.r * s.r).sum() + s.rest


def _active_residual(s: KnotValues, nu: jax.Array) -> jax.Array:
    """Return the constraint rows minus their active bounds."""
    return s.c - jnp.where((nu < 0) & jnp.isfinite(s.low), s.low, s.high)


def _active_bounds(
    x: jax.Array, low: jax.Array, high: jax.Array, slope: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return masks of the entries at active lower and upper bounds, by the sign of the slope."""
    rounding = BOUND_ROUNDING * jnp.finfo(x.dtype).eps
    at_low = (x <= low + rounding * (1 + jnp.abs(low))) & (slope > 0)
    return at_low, (x >= high - rounding * (1 + jnp.abs(high))) & (slope < 0)


def _gauss_newton(J: jax.Array) -> jax.Array:
    """Return the Gauss-Newton Hessian of r.r / 2, with a regularised diagonal."""
    n = J.shape[1]
    H = transpose_product(J, J)
    return H + REGULAR * (1 + jnp.trace(H) / n) * jnp.eye(n, dtype=H.dtype)


def _size(g: KKTUnknowns) -> jax.Array:
    """Return the largest absolute entry; nan if any entry is nan."""
    return jnp.stack([jnp.abs(x).max(initial=0.0) for x in g]).max()
