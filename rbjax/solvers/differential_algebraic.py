"""Implicit methods for differential-algebraic equations, whatever their index.

    f(t, y, y', w) = 0,      n + m equations, n rates y' and m algebraic unknowns w
    stages:  f(t_i, Y_i, Y'_i, W_i) = 0,      Y_i = y_i + h sum_j a_ij Y'_j
with A invertible: Radau IIA, Gauss, Lobatto IIIC, and one stage for a BDF. The last m equations may
have no w and no y' in them; where y' is found from them after p integrations, they are taken as
(h A)^-p of themselves. So the matrix does not degenerate as h goes to zero, and it is

    [M  -G^T]
    [G    0 ]       for constraints of index 2 (p = 1) and 3 (p = 2), up to terms in h.

The iteration is Newton's with the matrix of the start of the step, factored once; where that does
not converge, with the matrices of the stages, factored each time. Redundant rows leave w open: the
matrix is regularized (`stage_matrix`), which changes steps of the iteration and not where they end;
w stays where the guess put it in directions that do nothing. Of a step that passes a singular
position rows vanish between its stages, and turn round: the matrix of the start is of no use, and
what a stage right there asks of w has no bound. So after some iterations w is drawn to the last
one, and not to its own value: the iteration settles, with what is left of a row that vanishes.
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

from rbjax.lanes import batch_first, matvec
from rbjax.lanes.proximal import proximal
from rbjax.solvers.stage_matrix import Factored, Matrix
from rbjax.solvers.steps import mixed

MAX_STEPS = 50
ROUNDING = 4  # units in the last place, beside the size of y
#: corrections that shrink by no more are rounding, where they are below so much of y, by bytes:
#: those of index 3 carry the rounding of positions, some 50 / h times
STALLED, STALLED_BELOW = 0.9, {4: 2e-3, 8: 1e-8}
#: iterations with matrices of the stages: so many towards the last w, then towards one of them; and
#: how strongly, by bytes
FREE, HELD, NEAR = 6, 9, {4: 1e-2, 8: 1e-8}


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
        moved = -Factored(matrix, usual, proximal(change.dtype)[0]).solved(change)
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
        s, n, size = len(y), self.n, jnp.maximum(1.0, jnp.abs(y).max())
        slopes = self.slope(*start, read)
        guess = jnp.broadcast_to(jnp.concatenate([start.rate, start.w]), (s, slopes.shape[0]))
        slopes = jnp.broadcast_to(slopes, (s, *slopes.shape))
        shared = Factored(self.matrix(slopes, h, weights), usual)

        def chord(x: jax.Array, held: jax.Array, count: jax.Array) -> tuple:
            return shared.once(self.residual(x, h, t, y, weights, read)), held

        def newton(x: jax.Array, held: jax.Array, count: jax.Array) -> tuple:
            slopes = self.slopes(x, h, t, y, weights, read)
            near = NEAR[y.dtype.itemsize]
            matrix = Factored(self.matrix(slopes, h, weights), usual, near)
            held = jnp.where(count < FREE, x[:, n:], held)
            r = self.residual(x, h, t, y, weights, read)
            return matrix.once(r, x[:, n:] - held), held

        def found(step: Callable, done: jax.Array, x: jax.Array, most: int) -> tuple:
            """Whether x is settled, and x or the guess."""

            def once(at: tuple) -> tuple:
                x, held, before, count, _ = at
                dx, held = step(x, held, count)
                x = x - dx
                scale = jnp.maximum(size, jnp.abs(h * x[:, :n]).max())
                now = jnp.abs(h * dx[:, :n]).max() / scale
                return x, held, now, count + 1, settled(now, before, count)

            def more(at: tuple) -> jax.Array:
                *_, before, count, done = at
                return ~done & (count < most) & ((count == 0) | jnp.isfinite(before))

            first = x, x[:, n:], jnp.full((), jnp.inf, y.dtype), jnp.array(0), done
            x, *_, done = jax.lax.while_loop(more, once, first)
            return done, jnp.where(done, x, guess)

        done, x = found(chord, jnp.array(False), guess, MAX_STEPS)
        done, x = found(newton, done, x, FREE + HELD)
        return jnp.append(x, done.astype(y.dtype))


def settled(now: jax.Array, before: jax.Array, count: jax.Array) -> jax.Array:
    """Whether corrections, relative to y, have become rounding."""
    eps, noise = float(jnp.finfo(now.dtype).eps), STALLED_BELOW[now.dtype.itemsize]
    ratio = now / jnp.where(before > 0, before, 1.0)
    falling = (count > 0) & (ratio < STALLED)
    coming = now * jnp.where(falling, ratio / (1 - jnp.where(falling, ratio, 0.0)), 1.0)
    stalled = (count > 0) & (ratio >= STALLED) & (now <= noise)
    return (coming <= ROUNDING * eps) | stalled
