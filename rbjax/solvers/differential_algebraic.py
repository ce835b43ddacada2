"""Implicit methods for differential-algebraic equations, whatever their index.

    f(t, y, y', w) = 0,      n + m equations, n rates y' and m algebraic unknowns w
    stages:  f(t_i, Y_i, Y'_i, W_i) = 0,      Y_i = y_i + h sum_j a_ij Y'_j
with A invertible: Radau IIA, Gauss, Lobatto IIIC, and one stage for a BDF. The last m equations may
have no w and no y' in them; where y' is found from them after p integrations, they are taken as
(h A)^-p of themselves. So the matrix does not degenerate as h goes to zero, and it is

    [M  -G^T]
    [G    0 ]       for constraints of index 2 (p = 1) and 3 (p = 2), up to terms in h.

The iteration is Newton's with the matrix of the start of the step, factored once. Redundant rows
leave w open: the Schur complement S of the w has eps diag(S) added, which changes steps of the
iteration and not where they end; w stays where the guess put it in directions that do nothing.
The derivative of the solution is that of the implicit function, to all orders.
(Hairer, Lubich & Roche, *The Numerical Solution of Differential-Algebraic Systems by Runge-Kutta
Methods*, 1989; Hairer & Wanner, *Solving Ordinary Differential Equations II*, VI, VII.)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import lu_factor, lu_solve

from rbjax.lanes import batch_first, matvec
from rbjax.lanes.proximal import damped as damped_by
from rbjax.solvers.steps import mixed

MAX_STEPS = 50
#: iterations with a matrix of the stages: with w as found so far, then with w held near the last
FREE, HELD = 6, 9
ROUNDING = 4  # units in the last place, beside the size of y
#: corrections that shrink by no more are rounding, where they are below so much of y, by bytes:
#: those of index 3 carry the rounding of positions, some 50 / h times
STALLED, STALLED_BELOW = 0.9, {4: 2e-3, 8: 1e-8}


@dataclass(frozen=True)
class Equations:
    """f: (t, y (n,), y' (n,), w (m,)) -> (n + m,); depth: the p of each of the last m rows; usual
    (m,): what a unit of each w does to its row, integrated back, where no row vanishes; 0 where
    that is not known."""

    f: Callable[..., jax.Array]
    depth: tuple[int, ...]
    usual: jax.Array


class Weights(NamedTuple):
    """A (s, s) of a method, and its inverse."""

    a: jax.Array
    inverse: jax.Array


class Point(NamedTuple):
    """Where the matrix is taken, and what the iteration starts from."""

    t: Any
    y: jax.Array
    rate: jax.Array
    w: jax.Array


class Stages(NamedTuple):
    """Rates (s, n), algebraic unknowns (s, m), and whether they were found (else those of the
    start)."""

    rates: jax.Array
    w: jax.Array
    ok: jax.Array


def solve(
    equations: Equations, h: Any, t: jax.Array, y: jax.Array, weights: Weights, start: Point
) -> Stages:
    """The stages at times t (s,), from base values y (s, n)."""
    s, n = y.shape
    f, read = jax.closure_convert(equations.f, *start)
    system = System(f, equations.depth, n)
    start, usual = jax.lax.stop_gradient((start, equations.usual))

    @eqx.filter_custom_jvp
    def root(h, t, y, weights, start, usual, read):
        return batch_first(system.iterated(h, t, y, weights, start, usual, read))

    @root.def_jvp
    def _(primals, tangents):
        found = root(*primals)  # with its own derivative: this rule
        h, t, y, weights, _, usual, read = primals
        x = found[:-1].reshape(s, -1)

        def off(h, t, y, weights, start, usual, read):
            del start, usual
            return system.residual(x, h, t, y, weights, read)

        _, change = eqx.filter_jvp(off, primals, tangents)
        matrix = system.matrix(system.slopes(x, h, t, y, weights, read), h, weights)
        moved = -Factored(matrix, usual).solved(change)
        return batch_first((found, jnp.append(moved, jnp.zeros_like(found[-1]))))

    found = root(h, t, y, weights, start, usual, tuple(read))
    x = found[:-1].reshape(s, -1)
    return Stages(x[:, :n], x[:, n:], found[-1] > 0)


def damped(equations: Equations, gamma_h: Any, start: Point, raw: jax.Array) -> jax.Array:
    """What an error raw (n,) of y leaves after an implicit Euler step of length gamma h of the
    linearized equations: without its stiff parts and those against the constraints."""
    start, usual = jax.lax.stop_gradient((start, equations.usual))
    n, one = raw.size, Weights(*[jnp.ones((1, 1), raw.dtype)] * 2)
    system = System(equations.f, equations.depth, n)
    slopes = system.slope(*start, ())[None]
    off = system.weighted(matvec(slopes[0, :, :n], raw)[None], gamma_h, one)
    change = -Factored(system.matrix(slopes, gamma_h, one), usual).solved(off)
    return raw + gamma_h * change[0, :n]


@dataclass(frozen=True)
class System:
    """The stage equations, with what f reads as an argument; n rates."""

    f: Callable[..., jax.Array]
    depth: tuple[int, ...]
    n: int

    def residual(self, x, h, t, y, weights, read) -> jax.Array:
        """(s, n + m) at x = (rates, w), its last rows integrated back."""
        k, w = x[:, : self.n], x[:, self.n :]
        out = jax.vmap(lambda *at: self.f(*at, *read))(t, y + h * mixed(weights.a, k), k, w)
        return self.weighted(out, h, weights)

    def weighted(self, rows: jax.Array, h: Any, weights: Weights) -> jax.Array:
        """Rows (s, n + m, ...): the last m by (h A)^-p."""
        back, parts, at = weights.inverse / h, [rows[:, : self.n]], self.n
        for p in self.depth:
            row = rows[:, at]
            for _ in range(p):
                row = mixed(back, row)
            parts.append(row[:, None])
            at += 1
        return jnp.concatenate(parts, 1)

    def slope(self, t, y, rate, w, read) -> jax.Array:
        """df / d(y, y', w) (n + m, 2 n + m) at a point."""
        n = self.n

        def f(z):
            return self.f(t, z[:n], z[n : 2 * n], z[2 * n :], *read)

        _, push = jax.linearize(f, jnp.concatenate([y, rate, w]))
        return jax.vmap(push, out_axes=-1)(jnp.eye(2 * n + len(w), dtype=y.dtype))

    def slopes(self, x, h, t, y, weights, read) -> jax.Array:
        """The same at each stage."""
        k, w = x[:, : self.n], x[:, self.n :]
        return jax.vmap(lambda t, y, k, w: self.slope(t, y, k, w, read))(
            t, y + h * mixed(weights.a, k), k, w
        )

    def matrix(self, slopes: jax.Array, h: Any, weights: Weights) -> Matrix:
        """d residual / d (rates, w), from the slopes at the stages (s, n + m, 2 n + m)."""
        n, s = self.n, len(slopes)
        m = slopes.shape[1] - n
        own = jnp.eye(s, dtype=slopes.dtype)[:, None, :, None]
        by_y, by_rate, by_w = (x[:, :, None] for x in jnp.split(slopes, (n, 2 * n), -1))
        coupled = h * weights.a[:, None, :, None]
        of_rates = self.weighted(own * by_rate + coupled * by_y, h, weights)
        of_w = self.weighted(own * by_w, h, weights)
        return Matrix(
            of_rates[:, :n].reshape(s * n, s * n),
            of_w[:, :n].reshape(s * n, s * m),
            of_rates[:, n:].reshape(s * m, s * n),
            of_w[:, n:].reshape(s * m, s * m),
        )

    def iterated(self, h, t, y, weights, start: Point, usual, read) -> jax.Array:
        """The root and 1, or the start and 0 where it was not found, in one array."""
        s, size = len(y), jnp.maximum(1.0, jnp.abs(y).max())
        slopes = self.slope(*start, read)
        guess = jnp.broadcast_to(jnp.concatenate([start.rate, start.w]), (s, slopes.shape[0]))

        def off(x: jax.Array) -> jax.Array:
            return self.residual(x, h, t, y, weights, read)

        def factored(slopes: jax.Array) -> Factored:
            return Factored(self.matrix(slopes, h, weights), usual)

        def found(step: Callable, x: jax.Array, done: jax.Array, most: int) -> tuple:
            """x and whether it is settled, by steps (x, held, count) -> dx, held."""

            def once(at: tuple) -> tuple:
                x, held, before, count, _ = at
                dx, held = step(x, held, count)
                x = x - dx
                scale = jnp.maximum(size, jnp.abs(h * x[:, : self.n]).max())
                now = jnp.abs(h * dx[:, : self.n]).max() / scale
                return x, held, now, count + 1, settled(now, before, count)

            def more(at: tuple) -> jax.Array:
                *_, before, count, done = at
                return ~done & (count < most) & ((count == 0) | jnp.isfinite(before))

            first = x, x[:, self.n :], jnp.full((), jnp.inf, y.dtype), jnp.array(0), done
            x, _, _, _, done = jax.lax.while_loop(more, once, first)
            return jnp.where(done, x, guess), done

        chord = factored(jnp.broadcast_to(slopes, (s, *slopes.shape)))

        def of_start(x: jax.Array, held: jax.Array, count: jax.Array) -> tuple:
            return chord.once(off(x)), held

        def of_stages(x: jax.Array, held: jax.Array, count: jax.Array) -> tuple:
            matrix = factored(self.slopes(x, h, t, y, weights, read))
            held = jnp.where(count < FREE, x[:, self.n :], held)
            return matrix.once(off(x), x[:, self.n :] - held), held

        x, done = found(of_start, guess, jnp.array(False), MAX_STEPS)
        x, done = found(of_stages, x, done, FREE + HELD)
        return jnp.append(x.ravel(), done.astype(y.dtype))


def settled(now: jax.Array, before: jax.Array, count: jax.Array) -> jax.Array:
    """Whether corrections, relative to y, have become rounding."""
    eps, noise = float(jnp.finfo(now.dtype).eps), STALLED_BELOW[now.dtype.itemsize]
    ratio = now / jnp.where(before > 0, before, 1.0)
    falling = (count > 0) & (ratio < STALLED)
    coming = now * jnp.where(falling, ratio / (1 - jnp.where(falling, ratio, 0.0)), 1.0)
    stalled = (count > 0) & (ratio >= STALLED) & (now <= noise)
    return (coming <= ROUNDING * eps) | stalled


class Matrix(NamedTuple):
    """Blocks: rows of the differential equations, then of the algebraic ones; columns of the rates,
    then of w."""

    rates: jax.Array
    w: jax.Array
    row_rates: jax.Array
    row_w: jax.Array


class Factored:
    """Solves by the Schur complement of the w, regularized."""

    def __init__(self, matrix: Matrix, usual: jax.Array):
        self._matrix = matrix
        eps, vanishing, self._again = damped_by(matrix.w.dtype)
        self._rates = lu_factor(matrix.rates)
        self._response = lu_solve(self._rates, matrix.w)
        S = matrix.row_w - _product(matrix.row_rates, self._response)
        D = jnp.abs(jnp.diagonal(S))
        B = jnp.tile(usual, len(D) // len(usual)) if len(D) else D
        least = jnp.where(B > 0, vanishing * B, jnp.finfo(D.dtype).eps * D.sum())
        E = eps * D + least
        self._added = jnp.where(E > 0, E, 1.0)
        self._schur = lu_factor(S + jnp.diag(self._added))

    def once(self, r: jax.Array, off: jax.Array | None = None) -> jax.Array:
        """x (s, n + m) of matrix x = r, regularized: towards zero, or to w less by `off` (s, m)."""
        s = len(r)
        n = len(self._matrix.rates) // s
        k = lu_solve(self._rates, r[:, :n].ravel())
        asked = r[:, n:].ravel() - matvec(self._matrix.row_rates, k)
        if off is not None:
            asked = asked + self._added * off.ravel()
        w = lu_solve(self._schur, asked)
        k = k - matvec(self._response, w)
        return jnp.concatenate([k.reshape(s, -1), w.reshape(s, -1)], 1)

    def solved(self, r: jax.Array) -> jax.Array:
        """The same, with what regularization did taken back."""
        x = self.once(r)
        for _ in range(self._again):
            x = x + self.once(r - self._times(x))
        return x

    def _times(self, x: jax.Array) -> jax.Array:
        s, n = len(x), len(self._matrix.rates) // len(x)
        k, w = x[:, :n].ravel(), x[:, n:].ravel()
        B = self._matrix
        top = matvec(B.rates, k) + matvec(B.w, w)
        bottom = matvec(B.row_rates, k) + matvec(B.row_w, w)
        return jnp.concatenate([top.reshape(s, -1), bottom.reshape(s, -1)], 1)


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)
