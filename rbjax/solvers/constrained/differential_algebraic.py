"""Implicit methods for differential-algebraic equations, whatever their index.

    f(t, y, y', w) = 0,      n + m equations, n rates y' and m algebraic unknowns w
    stages:  f(t_i, Y_i, Y'_i, W_i) = 0,      Y_i = y_i + h sum_j a_ij Y'_j
with A invertible: Radau IIA, Gauss, Lobatto IIIC, and one stage for a BDF. The last m equations may
have no w and no y' in them; where y' is found from them after p integrations, they are taken as
(h A)^-p of themselves. So the matrix does not degenerate as h goes to zero, and it is

    [M  -G^T]
    [G    0 ]       for constraints of index 2 (p = 1) and 3 (p = 2), up to terms in h.

The iteration is Newton's with the matrix of the start of the step, inverted once, in blocks of the
size of one stage (`simplified`); where that does not converge, with the matrices of the stages,
factored each time (`stage_matrix`). Redundant rows leave w open: both are regularized, which
changes steps of the iteration and not where they end; w stays where the guess put it in directions
that do nothing. Of a step that passes a singular position rows vanish between its stages, and turn
round: the matrix of the start is of no use, and what a stage right there asks of w has no bound. So
after some iterations w is drawn to the last one, and not to its own value: the iteration settles,
with what is left of a row that vanishes.
The derivative of the solution is that of the implicit function, to all orders, by the same two
ways. A GPU thread has no room for the matrices of the stages of mechanisms above `COUPLED_UP_TO`:
there the second iteration keeps the complement of w only (`complement`), and above `SWEPT_UP_TO`
steps that the first iteration does not solve are not solved.
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
from rbjax.lanes.arrays import each
from rbjax.lanes.factorization import proximal
from rbjax.solvers.common.steps import mixed
from rbjax.solvers.constrained.complement import Complement, complement
from rbjax.solvers.constrained.simplified import Blocks, Simplified, Sizes, simplified
from rbjax.solvers.constrained.spectrum import Weights, weight
from rbjax.solvers.constrained.stage_matrix import Factored, Matrix

MAX_STEPS = 50
ROUNDING = 4  # units in the last place, beside the size of y
#: corrections that shrink by no more are rounding, where they are below so much of y, by bytes:
#: those of index 3 carry the rounding of positions, some 50 / h times
STALLED, STALLED_BELOW = 0.9, {4: 2e-3, 8: 1e-8}
#: the same of a linear system, in units in the last place: nothing else is divided by h there
LINEAR_NOISE = 100
#: by sweeps, which go through rows that nearly vanish, by bytes
SWEPT_NOISE = {4: 1e3, 8: 1e5}
#: iterations with matrices of the stages: so many towards the last w, then towards one of them; and
#: how strongly, by bytes
FREE, HELD, NEAR = 6, 9, {4: 1e-2, 8: 1e-8}
#: the same of a GPU thread, whose iteration converges less fast
SWEEPS = 24
#: the most unknowns of all stages whose matrix a GPU thread has memory for
COUPLED_UP_TO = 40
#: the most for which it has memory for the complement of their w, and for so long a program
SWEPT_UP_TO = 200


@dataclass(frozen=True)
class Equations:
    """f: (t, y (n,), y' (n,), w (m,)) -> (n + m,); depth: the p of each of the last m rows; usual
    (m,): what a unit of each w does to its row, integrated back, where no row vanishes; 0 where
    that is not known; kinematic, again: as in `rbjax.solvers.constrained.simplified.Sizes`."""

    f: Callable[..., jax.Array]
    depth: tuple[int, ...]
    usual: jax.Array
    kinematic: int
    again: int = 0


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
    # jitted, so that it is traced once for all that calls and differentiates it
    system = System(jax.jit(f), Sizes(n, equations.kinematic, equations.depth, equations.again))
    start, usual = jax.lax.stop_gradient((start, equations.usual))

    @eqx.filter_custom_jvp
    def root(h, t, y, weights, start, usual, read):
        blocks = system.simplified(h, weights, start, usual, read)
        return batch_first((system.iterated(blocks, h, t, y, weights, start, usual, read), blocks))

    @root.def_jvp
    def _(primals, tangents):
        found, blocks = root(*primals)  # with its own derivative: this rule
        x = found[:-1].reshape(s, -1)

        def off(h, t, y, weights, start, usual, read):
            del start, usual
            return system.residual(x, h, t, y, weights, read)

        _, change = eqx.filter_jvp(off, primals, tangents)
        moved = -system.moved(x, change, blocks, *primals)
        moved = jnp.append(moved, jnp.zeros_like(found[-1]))
        # the blocks draw iterations to where they end, and do not change that
        still = jax.tree.map(jnp.zeros_like, blocks)
        return (found, blocks), batch_first((moved, still))

    found, _ = root(h, t, y, weights, start, usual, tuple(read))
    x = found[:-1].reshape(s, -1)
    return Stages(x[:, :n], x[:, n:], found[-1] > 0)


def damped(equations: Equations, gamma_h: Any, start: Point, raw: jax.Array) -> jax.Array:
    """What an error raw (n,) of y leaves after an implicit Euler step of length gamma h of the
    linearized equations: without its stiff parts and those against the constraints."""
    start, usual = jax.lax.stop_gradient((start, equations.usual))
    n, one = raw.size, weight(jnp.ones((), raw.dtype))
    system = System(equations.f, Sizes(n, 0, equations.depth, 0))
    slopes = system.slope(*start, ())[None]
    off = system.weighted(matvec(slopes[0, :, :n], raw)[None], gamma_h, one)
    change = -Factored(system.matrix(slopes, gamma_h, one), usual).solved(off)
    return raw + gamma_h * change[0, :n]


@dataclass(frozen=True)
class System:
    """The stage equations, with what f reads as an argument."""

    f: Callable[..., jax.Array]
    sizes: Sizes

    @property
    def n(self) -> int:
        return self.sizes.n

    def residual(self, x, h, t, y, weights, read) -> jax.Array:
        """(s, n + m) at x = (rates, w), its last rows integrated back."""
        k, w = x[:, : self.n], x[:, self.n :]
        out = each(lambda *at: self.f(*at, *read), t, y + h * mixed(weights.a, k), k, w)
        return self.weighted(out, h, weights)

    def weighted(self, rows: jax.Array, h: Any, weights: Weights) -> jax.Array:
        """Rows (s, n + m, ...): the last m by (h A)^-p."""
        back, parts, at = weights.inverse / h, [rows[:, : self.n]], self.n
        for p in self.sizes.depth:
            row = rows[:, at]
            for _ in range(p):
                row = mixed(back, row)
            parts.append(row[:, None])
            at += 1
        return jnp.concatenate(parts, 1)

    def slope(self, t, y, rate, w, read) -> jax.Array:
        """df / d(y, y', w) (n + m, 2 n + m) at a point."""
        one = jnp.eye(2 * self.n + len(w), dtype=y.dtype)
        return each(self.push(t, y, rate, w, read), one).T

    def push(self, t, y, rate, w, read) -> Callable[[jax.Array], jax.Array]:
        """df of d(y, y', w) (2 n + m,) at a point."""
        n = self.n

        def f(z):
            return self.f(t, z[:n], z[n : 2 * n], z[2 * n :], *read)

        at = jnp.concatenate([y, rate, w])
        return lambda d: jax.jvp(f, (at,), (d,))[1]

    def simplified(self, h, weights, start: Point, usual, read) -> Blocks:
        """The matrix of the start, for all stages."""
        return simplified(self.push(*start, read), self.sizes, h, weights, usual)

    def complement(self, x, shared: Simplified, h, t, y, weights, usual, read) -> Complement:
        """Of the w of all stages, at x."""

        def push(d: jax.Array) -> jax.Array:
            return jax.jvp(lambda x: self.residual(x, h, t, y, weights, read), (x,), (d,))[1]

        near = NEAR[y.dtype.itemsize]
        return complement(push, shared.free, usual, len(y), self.n, near)

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

    def iterated(self, blocks: Blocks, h, t, y, weights, start: Point, usual, read) -> jax.Array:
        """The root and 1, or the start and 0 where it was not found, in one array."""
        s, n, size = len(y), self.n, jnp.maximum(1.0, jnp.abs(y).max())
        guess = jnp.broadcast_to(jnp.concatenate([start.rate, start.w]), (s, n + len(start.w)))
        shared = Simplified(self.sizes, *jax.lax.stop_gradient((h, weights, blocks)))

        def chord(x: jax.Array, held: jax.Array, count: jax.Array) -> tuple:
            return shared.solved(self.residual(x, h, t, y, weights, read)), held

        def newton(x: jax.Array, held: jax.Array, count: jax.Array) -> tuple:
            slopes = self.slopes(x, h, t, y, weights, read)
            near = NEAR[y.dtype.itemsize]
            matrix = Factored(self.matrix(slopes, h, weights), usual, near)
            held = jnp.where(count < FREE, x[:, n:], held)
            r = self.residual(x, h, t, y, weights, read)
            return matrix.once(r, x[:, n:] - held), held

        def sweep(x: jax.Array, held: jax.Array, count: jax.Array) -> tuple:
            held = jnp.where(count < FREE, x[:, n:], held)
            S = self.complement(x, shared, h, t, y, weights, usual, read)

            def off(x: jax.Array) -> jax.Array:
                return self.residual(x, h, t, y, weights, read)

            return x - S.swept(off, shared.free, x, held), held

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
        done, x = where_it_fits(
            guess.size,
            lambda done, x: found(newton, done, x, FREE + HELD),
            lambda done, x: found(sweep, done, x, FREE + SWEEPS),
            lambda done, x: (done, x),
        )(done, x)
        return jnp.append(x, done.astype(y.dtype))

    def moved(
        self, x, change, blocks: Blocks, h, t, y, weights, start: Point, usual, read
    ) -> jax.Array:
        """The changes (s, n + m) of x at the root that make one of the residual.

        By iteration with the matrix of the start; where that does not converge, with those of the
        stages.
        """
        shared = Simplified(self.sizes, *jax.lax.stop_gradient((h, weights, blocks)))

        def push(d: jax.Array) -> jax.Array:
            return jax.jvp(lambda x: self.residual(x, h, t, y, weights, read), (x,), (d,))[1]

        def back(d: jax.Array) -> jax.Array:
            return jax.linear_transpose(shared.solved, d)(d)[0]

        def free_back(d: jax.Array) -> jax.Array:
            return jax.linear_transpose(shared.free, d)(d)[0]

        def by(nearly: Callable, transposed: bool) -> Callable:
            def solved(push: Callable, b: jax.Array) -> jax.Array:
                found, done = refined(push, nearly, b, self.n)

                def directly(_: tuple) -> tuple:
                    matrix = self.matrix(self.slopes(x, h, t, y, weights, read), h, weights)
                    matrix = matrix.transposed if transposed else matrix
                    exact = Factored(matrix, usual, proximal(b.dtype)[0]).solved(b)
                    return exact, jnp.array(True)

                def by_sweeps(_: tuple) -> tuple:
                    S = self.complement(x, shared, h, t, y, weights, usual, read)
                    S = S._replace(transposed=transposed)
                    exact, ok = swept(push, S, free_back if transposed else shared.free, b, self.n)
                    return jnp.where(ok, exact, jnp.nan), jnp.array(True)

                def once(f: Callable) -> Callable:
                    # a loop and not a branch: of a batch both branches would run
                    return lambda *at: jax.lax.while_loop(lambda at: ~at[1], f, at)[0]

                def given_up(found: jax.Array, done: jax.Array) -> jax.Array:
                    return jnp.where(done, found, jnp.nan)

                fitting = where_it_fits(x.size, once(directly), once(by_sweeps), given_up)
                return fitting(found, done)

            return solved

        return jax.lax.custom_linear_solve(push, change, by(shared.solved, False), by(back, True))


def where_it_fits(unknowns: int, f: Callable, smaller: Callable, otherwise: Callable) -> Callable:
    """f, which needs a matrix of so many unknowns; what a GPU does where a thread has no room."""
    if unknowns <= COUPLED_UP_TO:
        return f
    on_gpu = smaller if unknowns <= SWEPT_UP_TO else otherwise
    return lambda *args: jax.lax.platform_dependent(*args, cuda=on_gpu, default=f)


def refined(push: Callable, nearly: Callable, b: jax.Array, n: int) -> tuple:
    """x of push(x) = b by corrections nearly(b - push(x)), and whether these became rounding."""
    return corrected(lambda x: nearly(b - push(x)), b, n)


def swept(push: Callable, S: Complement, free: Callable, b: jax.Array, n: int) -> tuple:
    """The same by sweeps."""
    noise = SWEPT_NOISE[b.dtype.itemsize]
    return corrected(lambda x: S.swept(lambda x: push(x) - b, free, x, x[:, n:]) - x, b, n, noise)


def corrected(correction: Callable, b: jax.Array, n: int, noise: float = LINEAR_NOISE) -> tuple:
    """x of corrections correction(x), from 0, and whether these have become rounding. The first n
    columns of x decide."""
    eps = float(jnp.finfo(b.dtype).eps)

    def once(at: tuple) -> tuple:
        x, before, count, _ = at
        dx = correction(x)
        x = x + dx
        size = jnp.abs(x[:, :n]).max()
        now = jnp.abs(dx[:, :n]).max() / jnp.where(size > 0, size, 1.0)
        return x, now, count + 1, settled(now, before, count, noise * eps)

    def more(at: tuple) -> jax.Array:
        _, before, count, done = at
        return ~done & (count < MAX_STEPS) & ((count == 0) | jnp.isfinite(before))

    start = jnp.zeros_like(b), jnp.full((), jnp.inf, b.dtype), jnp.array(0), jnp.array(False)
    x, _, _, done = jax.lax.while_loop(more, once, start)
    return x, done


def settled(
    now: jax.Array, before: jax.Array, count: jax.Array, noise: float | None = None
) -> jax.Array:
    """Whether corrections, relative to y, have become rounding; noise: what rounding is at most."""
    eps = float(jnp.finfo(now.dtype).eps)
    noise = STALLED_BELOW[now.dtype.itemsize] if noise is None else noise
    ratio = now / jnp.where(before > 0, before, 1.0)
    falling = (count > 0) & (ratio < STALLED)
    coming = now * jnp.where(falling, ratio / (1 - jnp.where(falling, ratio, 0.0)), 1.0)
    stalled = (count > 0) & (ratio >= STALLED) & (now <= noise)
    return (coming <= ROUNDING * eps) | stalled
