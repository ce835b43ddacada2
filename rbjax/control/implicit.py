"""Derivatives of an optimum by the implicit function theorem.

At an optimum z = (x, u, l, nu) of states, free controls, costates and multipliers, the gradient of

    L = sum_k L_k(x_k, u_k) + l_{k+1}.(f(x_k, u_k) - x_{k+1}) + nu_k.(c_k - b_k),   l_0.(start - x_0)

is zero whatever the numbers p of the problem are, so that

    K dz = - d(grad L)/dp dp,      K = d(grad L)/dz,  symmetric

(Fiacco, *Introduction to Sensitivity and Stability Analysis in Nonlinear Programming*, 1983; Amos et
al., *Differentiable MPC*, 2018). A control at a bound that presses it moves with the bound; of
inequalities those count whose multiplier is not zero. `riccati_solve` solves the equations in O(N),
for forward and reverse mode, and nothing of the iterations is kept.

Where K is not that of a minimum (the search has not converged), the Hessians are those of Gauss and
Newton: the derivative is finite, and `outcome` says that it is not one of an optimum.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.control.expansion import limits
from rbjax.control.outcome import CONVERGED
from rbjax.control.problem import Knot, Problem
from rbjax.control.riccati_solve import (
    Equations,
    Factor,
    Unknowns,
    congruence,
    factorised,
    masked,
    product,
    solved,
    times_matrix,
)
from rbjax.control.solution import Found

NEAR = 64.0  # units in the last place between a control and a bound that holds it
REGULAR = 1e-6  # of the mean of a diagonal: added to Hessians of Gauss and Newton
POLISH = 1  # Newton steps before the derivative is taken: a search ends at a finite tolerance


class Seen(NamedTuple):
    """Of a knot, beside it by d: residuals r, what costs beside them, the next knot less the one
    that follows (n,), and constraints c with their bounds."""

    r: jax.Array
    rest: jax.Array
    after: jax.Array
    c: jax.Array
    low: jax.Array
    high: jax.Array


class Functions(NamedTuple):
    """What a derivative needs of a problem. Each takes first what hoisting found, then the arrays
    of the problem. run: the search; path and end: `Seen` of a knot."""

    run: Callable[..., Found]
    path: Callable[..., Seen]
    end: Callable[..., Seen]


class Point(NamedTuple):
    """Where a derivative is taken; path and end: multipliers."""

    knots: Knot
    ctrls: jax.Array
    path: jax.Array
    end: jax.Array


def differentiable(
    search: Callable[..., Found], problem: Problem, start: Any, knots: Knot, ctrls: jax.Array,
    options: Any,
) -> Found:  # fmt: skip
    """search(problem, start, knots, ctrls, options), with derivatives of the optimum by the arrays
    of the problem, what its functions close over, and the start. Gains and the account of the
    iterations are constants to them, and nothing depends on the first guess."""
    arrays, rest = eqx.partition(problem, eqx.is_array)
    N, n, m = problem.horizon, problem.n, problem.nu

    def whole(arrays: Any) -> Problem:
        return eqx.combine(arrays, rest)

    def run(arrays: Any, *given: Any) -> Found:
        return search(whole(arrays), *given)

    def path(arrays: Any, d: jax.Array, k: Any, knot: Knot, ctrl: jax.Array, following: Knot):
        p = whole(arrays)
        there, u = p.plus(knot, d[:n]), ctrl + d[n:]
        r, beside = p.values(p.running, k, there, u)
        c = p.rows(k, there, u, "path")
        return Seen(r, beside, p.minus(p.step(k, there, u), following), c, *limits(p, "path", c))

    def end(arrays: Any, d: jax.Array, knot: Knot):
        p = whole(arrays)
        there, u = p.plus(knot, d), jnp.zeros(m, d.dtype)
        r, beside = p.values(p.terminal, N, there, u)
        c = p.rows(N, there, u, "end")
        return Seen(r, beside, jnp.zeros(0, d.dtype), c, *limits(p, "end", c))

    given = (arrays, start, knots, ctrls, options)
    functions, found = Functions(_plain(run), _plain(path), _plain(end)), ()
    if any(map(_may_read_tracers, jax.tree.leaves(rest))):
        one = jax.tree.map(lambda x: x[0], knots)
        d, number = jnp.zeros(n + m, ctrls.dtype), jnp.zeros((), ctrls.dtype)
        functions, found = _hoisted(
            Functions(run, path, end),
            Functions(given, (arrays, d, number, one, ctrls[0], one), (arrays, d[:n], one)),
        )

    @jax.custom_jvp
    def optimum(found: tuple, *given: Any) -> Found:
        return functions.run(found, *given)

    @optimum.defjvp
    def rule(primals: tuple, tangents: tuple) -> tuple[Found, Found]:
        out = optimum(*primals)
        numbers, directions = primals[:3], tangents[:3]
        return out, _moved(functions, whole, out, numbers, directions)

    return optimum(found, *given)


# ------------------------------------------------------------ functions that close over tracers


def _plain(f: Callable) -> Callable:
    return lambda _, *args: f(*args)


def _may_read_tracers(f: Any) -> bool:
    """Whether a function may read numbers that are not among the arrays of a problem."""
    if not callable(f):
        return False
    inside = getattr(f, "__wrapped__", f)
    if not hasattr(inside, "__code__"):
        return type(f).__name__ != "builtin_function_or_method"
    held = (getattr(inside, x) for x in ("__closure__", "__defaults__", "__kwdefaults__"))
    return any(x is not None for x in held)


def _hoisted(functions: Functions, examples: Functions) -> tuple[Functions, tuple]:
    """The functions with all tracers that they close over as their first argument, and these."""
    made, found = [], []
    for f, example in zip(functions, examples, strict=True):
        traced, shape = jax.make_jaxpr(f, return_shape=True)(*example)
        tree = jax.tree.structure(shape)
        places = [i for i, x in enumerate(traced.consts) if isinstance(x, jax.core.Tracer)]
        made.append(_evaluates(traced, tree, places, len(found)))
        found.extend(traced.consts[i] for i in places)
    return Functions(*made), tuple(found)


def _evaluates(traced: Any, tree: Any, places: list[int], at: int) -> Callable:
    consts = [None if i in places else x for i, x in enumerate(traced.consts)]

    def run(found: tuple, *args: Any) -> Any:
        filled = list(consts)
        for j, i in enumerate(places):
            filled[i] = found[at + j]
        out = jax.core.eval_jaxpr(traced.jaxpr, filled, *jax.tree.leaves(args))
        return jax.tree.unflatten(tree, out)

    return run


# ------------------------------------------------------------ the derivative


def _moved(
    functions: Functions, whole: Callable, out: Found, numbers: tuple, directions: tuple
) -> Found:
    """The tangents of what was found."""
    point = Point(out.knots, out.ctrls, out.path, out.end)
    view = _View(functions, whole, numbers, point)
    for _ in range(POLISH):
        view = view.polished(out.outcome == CONVERGED)
    dz, du = view.tangent(directions)
    problem = whole(numbers[1])

    def moved(x: jax.Array) -> Knot:
        return jax.vmap(problem.plus)(out.knots, x)

    knots = jax.jvp(moved, (jnp.zeros_like(dz.x),), (dz.x,))[1]
    cost = view.cost_tangent(directions, dz.x, du)
    zero = jax.tree.map(_no_tangent, out)
    return zero._replace(knots=knots, ctrls=du, cost=cost, path=dz.path, end=dz.end)


def _no_tangent(x: jax.Array) -> Any:
    x = jnp.asarray(x)
    dtype = jax.dtypes.float0 if not jnp.issubdtype(x.dtype, jnp.inexact) else x.dtype
    return np.zeros(x.shape, dtype) if dtype == jax.dtypes.float0 else jnp.zeros(x.shape, dtype)


class _View:
    """A problem near a point: the gradient of L there, the equations, and their factor."""

    def __init__(
        self, functions: Functions, whole: Callable, numbers: tuple, point: Point
    ) -> None:
        self.functions, self.whole, self.numbers, self.point = functions, whole, numbers, point
        problem = self.problem = whole(numbers[1])
        dtype, N = point.ctrls.dtype, problem.horizon
        self.ks = jnp.arange(N, dtype=dtype)
        self.body = jax.tree.map(lambda x: x[:-1], point.knots)
        self.following = jax.tree.map(lambda x: x[1:], point.knots)
        self.last = jax.tree.map(lambda x: x[-1], point.knots)
        self.n, self.m = problem.n, problem.nu
        self.l, pressed, equal, *self.jacobians = self._first_order()
        self._active(pressed, *equal)

    # one knot

    def _path(self, numbers: tuple, d: jax.Array, *knot: Any) -> Seen:
        return self.functions.path(numbers[0], numbers[1], d, *knot)

    def _end(self, numbers: tuple, d: jax.Array) -> Seen:
        return self.functions.end(numbers[0], numbers[1], d, self.last)

    def _first_order(self) -> tuple:
        """Costates (N + 1, n), the gradient by controls (N, m), and Jacobians."""
        n, m, dtype = self.n, self.m, self.point.ctrls.dtype
        at = (self.ks, self.body, self.point.ctrls, self.following)

        def one(k: Any, knot: Knot, ctrl: jax.Array, following: Knot, nu: jax.Array) -> tuple:
            def seen(d: jax.Array) -> tuple:
                s = self._path(self.numbers, d, k, knot, ctrl, following)
                return (s.after, s.c, _cost(s) + (nu * s.c).sum()), s.low == s.high

            return jax.jacfwd(seen, has_aux=True)(jnp.zeros(n + m, dtype))

        (F, G, g), equal = jax.vmap(one)(*at, self.point.path)

        def closing(d: jax.Array) -> tuple:
            s = self._end(self.numbers, d)
            return (s.c, _cost(s) + (self.point.end * s.c).sum()), s.low == s.high

        (E, l_N), equal_N = jax.jacfwd(closing, has_aux=True)(jnp.zeros(n, dtype))

        def back(l: jax.Array, x: tuple) -> tuple:
            F, g = x
            g = g + product(F.T, l)
            return g[:n], (l, g[n:])

        l_0, (l, pressed) = jax.lax.scan(back, l_N, (F, g), reverse=True)
        blocks = (F[:, :, :n], F[:, :, n:], G[:, :, :n], G[:, :, n:], E)
        return jnp.concatenate([l_0[None], l]), pressed, (equal, equal_N), *blocks

    def _active(self, pressed: jax.Array, equal: jax.Array, equal_N: jax.Array) -> None:
        """Which bounds and rows hold what."""
        problem, point, dtype = self.problem, self.point, self.point.ctrls.dtype
        low, high = self._bounds(self.numbers)
        at_low, at_high = _held(point.ctrls, low, high, pressed)
        self.at_low, self.at_high = at_low, at_high
        self.free = jnp.where(at_low | at_high, 0.0, 1.0).astype(dtype)
        numbers = point.knots.numbers[0]
        low, high = self._first_bounds(self.numbers)
        self.first_low, self.first_high = _held(numbers, low, high, self.l[0, problem.system.n :])
        fixed = [~jnp.asarray(problem.free, bool), self.first_low | self.first_high]
        self.fixed = jnp.concatenate(fixed).astype(dtype)
        self.rows_path = ((point.path != 0) | equal).astype(dtype)
        self.rows_end = ((point.end != 0) | equal_N).astype(dtype)

    def _bounds(self, numbers: tuple) -> tuple[jax.Array, jax.Array]:
        problem, dtype = self.whole(numbers[1]), self.point.ctrls.dtype
        if not problem.bounded:
            return jnp.full(self.m, -jnp.inf, dtype), jnp.full(self.m, jnp.inf, dtype)
        return problem.low.astype(dtype), problem.high.astype(dtype)

    def _first_bounds(self, numbers: tuple) -> tuple[jax.Array, jax.Array]:
        problem = self.whole(numbers[1])
        ends = problem.start_bounds(self.point.ctrls.dtype)
        low, high = (x[problem.system.n :] for x in ends)
        return low, high

    # L

    def _controls(self, numbers: tuple) -> jax.Array:
        """The controls, those at a bound as functions of it."""
        low, high = self._bounds(numbers)
        u = jnp.where(self.at_low, low, self.point.ctrls)
        return jnp.where(self.at_high, high, u)

    def gradient(self, numbers: tuple) -> Unknowns:
        """The gradient of L by the unknowns."""
        n, point, dtype = self.n, self.point, self.point.ctrls.dtype
        ctrls = self._controls(numbers)

        def one(k, knot, ctrl, following, l, nu):
            def L(d: jax.Array) -> tuple:
                s = self._path(numbers, d, k, knot, ctrl, following)
                return _cost(s) + (l * s.after).sum() + (nu * s.c).sum(), s

            g, s = jax.grad(L, has_aux=True)(jnp.zeros(n + self.m, dtype))
            return g, s.after, _off(s, nu)

        rest = (self.following, self.l[1:], point.path)
        g, gap, off = jax.vmap(one)(self.ks, self.body, ctrls, *rest)

        def closing(d: jax.Array) -> tuple:
            s = self._end(numbers, d)
            return _cost(s) + (point.end * s.c).sum(), _off(s, point.end)

        g_N, off_N = jax.grad(closing, has_aux=True)(jnp.zeros(n, dtype))
        gx = jnp.concatenate([g[:, :n], g_N[None]])
        before = jnp.concatenate([(self.fixed * self.l[0])[None], self.l[1:]])
        first = jnp.concatenate([self._opening(numbers)[None], gap])
        return Unknowns(
            gx - before, self.free * g[:, n:], first, self.rows_path * off, self.rows_end * off_N
        )

    def _opening(self, numbers: tuple) -> jax.Array:
        """What is fixed of the first knot less where it is."""
        system = self.whole(numbers[1]).system
        first = jax.tree.map(lambda x: x[0], self.point.knots)
        low, high = self._first_bounds(numbers)
        held = jnp.where(self.first_low, low, jnp.where(self.first_high, high, first.numbers))
        off = [system.minus(numbers[2], first.state), held - first.numbers]
        return self.fixed * jnp.concatenate(off)

    @functools.cached_property
    def _factor(self) -> tuple[Equations, Factor]:
        A, B, C, D, E = self.jacobians
        n, m, point, dtype = self.n, self.m, self.point, self.point.ctrls.dtype

        def one(k, knot, ctrl, following, l, nu):
            def seen(d: jax.Array) -> Seen:
                return self._path(self.numbers, d, k, knot, ctrl, following)

            def L(d: jax.Array) -> jax.Array:
                s = seen(d)
                return _cost(s) + (l * s.after).sum() + (nu * s.c).sum()

            return _hessians(L, lambda d: seen(d).r, jnp.zeros(n + m, dtype))

        at = (self.ks, self.body, point.ctrls, self.following, self.l[1:], point.path)
        H, H_gauss = jax.vmap(one)(*at)

        def closing(d: jax.Array) -> jax.Array:
            s = self._end(self.numbers, d)
            return _cost(s) + (point.end * s.c).sum()

        H_N, gauss_N = _hessians(
            closing, lambda d: self._end(self.numbers, d).r, jnp.zeros(n, dtype)
        )

        def made(H: jax.Array, H_N: jax.Array) -> Equations:
            Q = jnp.concatenate([H[:, :n, :n], H_N[None]])
            masks = (self.fixed, self.free, self.rows_path, self.rows_end)
            return masked(Equations(A, B, Q, H[:, :n, n:], H[:, n:, n:], C, D, E, *masks))

        exact, gauss = made(H, H_N), made(H_gauss, gauss_N)
        found = factorised(exact)
        fine = found.ok
        e = jax.tree.map(lambda x, y: jnp.where(fine, x, y), exact, gauss)
        return e, jax.lax.cond(fine, lambda: found, lambda: factorised(gauss))

    # what is asked

    def solve(self, r: Unknowns) -> Unknowns:
        """z of K z = r."""
        e, f = self._factor
        return jax.lax.custom_linear_solve(
            lambda z: times_matrix(e, z), r, lambda _, r: solved(e, f, r), symmetric=True
        )

    def polished(self, wanted: jax.Array) -> _View:
        """After a step of Newton, where it is wanted and brings the gradient nearer to zero."""
        g = self.gradient(self.numbers)
        z = self.solve(jax.tree.map(jnp.negative, g))
        point, ctrls = self.point, self._controls(self.numbers)
        new = Point(
            jax.vmap(self.problem.plus)(point.knots, z.x), ctrls + z.u,
            point.path + z.path, point.end + z.end,
        )  # fmt: skip
        after = _View(self.functions, self.whole, self.numbers, new)
        better = wanted & (_size(after.gradient(self.numbers)) < _size(g))
        best = jax.tree.map(lambda x, y: jnp.where(better, x, y), new, point)
        return _View(self.functions, self.whole, self.numbers, best)

    def tangent(self, directions: tuple) -> tuple[Unknowns, jax.Array]:
        """How the unknowns move, and the controls."""
        change = jax.jvp(self.gradient, (self.numbers,), (directions,))[1]
        dz = self.solve(jax.tree.map(jnp.negative, change))
        held = jax.jvp(self._controls, (self.numbers,), (directions,))[1]
        return dz, dz.u + held

    def cost_tangent(self, directions: tuple, dx: jax.Array, du: jax.Array) -> jax.Array:
        """How the cost moves."""

        def cost(numbers: tuple, x: jax.Array, u: jax.Array) -> jax.Array:
            def one(d: jax.Array, *knot: Any) -> jax.Array:
                return _cost(self._path(numbers, d, *knot))

            d = jnp.concatenate([x[:-1], u], 1)
            at = (self.ks, self.body, self.point.ctrls, self.following)
            return jax.vmap(one)(d, *at).sum() + _cost(self._end(numbers, x[-1]))

        zero = (jnp.zeros_like(dx), jnp.zeros_like(du))
        return jax.jvp(cost, (self.numbers, *zero), (directions, dx, du))[1]


def _cost(s: Seen) -> jax.Array:
    return 0.5 * (s.r * s.r).sum() + s.rest


def _off(s: Seen, nu: jax.Array) -> jax.Array:
    """Rows less the bound that holds them."""
    return s.c - jnp.where((nu < 0) & jnp.isfinite(s.low), s.low, s.high)


def _held(
    x: jax.Array, low: jax.Array, high: jax.Array, slope: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Whether x lies at the low and at the high bound, and the cost presses it there."""
    near = NEAR * jnp.finfo(x.dtype).eps
    at_low = (x <= low + near * (1 + jnp.abs(low))) & (slope > 0)
    return at_low, (x >= high - near * (1 + jnp.abs(high))) & (slope < 0)


def _hessians(L: Callable, r: Callable, zero: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Of L, and of r.r / 2 by Gauss and Newton, with a little on its diagonal."""
    J = jax.jacfwd(r)(zero)
    gauss = congruence(J, J) if J.shape[0] else jnp.zeros((zero.shape[0],) * 2, zero.dtype)
    little = REGULAR * (1 + jnp.trace(gauss) / zero.shape[0])
    return jax.jacfwd(jax.grad(L))(zero), gauss + little * jnp.eye(zero.shape[0], dtype=zero.dtype)


def _size(g: Unknowns) -> jax.Array:
    """The largest entry, nan if there is one."""
    return jnp.stack([jnp.abs(x).max(initial=0.0) for x in g]).max()
