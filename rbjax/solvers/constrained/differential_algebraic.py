"""Implicit steps of differential-algebraic equations of any index.

    f(t, y, y', w) = 0,      n + m equations, n rates y' and m algebraic unknowns w
    stages:  f(t_i, Y_i, Y'_i, W_i) = 0,      Y_i = y_i + h sum_j a_ij Y'_j
with A invertible: Radau IIA, Gauss, Lobatto IIIC, and one stage for a BDF. A row from which y'
follows after p integrations is multiplied by (h A)^-p, so that the matrix

    [M  -G^T]
    [G    0 ]       (index 2: p = 1; index 3: p = 2; up to terms in h)
is regular for h = 0. Newton's iteration uses the matrix at the start of the step, inverted in
blocks of one stage (`simplified`). If it does not converge, as near singular positions, it uses the
matrices at the stages (`schur_complement`). After `FREE` iterations these are regularized towards a
constant w, so that the iteration also converges if a row vanishes. Regularization changes
corrections, not the solution. Derivatives use the implicit function theorem.

A GPU thread has no memory for the matrices of the stages above `COUPLED_UP_TO` unknowns. Up to
`SWEPT_UP_TO` unknowns the second iteration uses `Complement` on a GPU. Above, there is no second
iteration.

Source: Hairer, Lubich & Roche, *The Numerical Solution of Differential-Algebraic Systems by
Runge-Kutta Methods*, 1989; Hairer & Wanner, *Solving Ordinary Differential Equations II*, VI, VII.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.lanes import batch_first, matvec
from rbjax.lanes.arrays import each
from rbjax.rank_tolerances import rank_tolerance
from rbjax.solvers.constrained.schur_complement import Complement, Factored, Matrix, complement
from rbjax.solvers.constrained.simplified import (
    Blocks,
    MethodMatrix,
    Simplified,
    Sizes,
    simplified,
    weight,
)
from rbjax.solvers.steps import weighted_sums

MAX_STEPS = 50
ROUNDING = 4  # units in the last place, relative to y
#: A correction is rounding if its ratio to the one before is above STALLED and it is below
#: STALLED_BELOW (by bytes of the dtype). Index 3 adds the rounding of positions times about 50 / h.
STALLED, STALLED_BELOW = 0.9, {4: 2e-3, 8: 1e-8}
#: noise of the corrections of a linear system, in units in the last place
LINEAR_NOISE = 100
#: noise of sweeps, by bytes of the dtype, in units in the last place
SWEPT_NOISE = {4: 1e3, 8: 1e5}
#: iterations with the matrices of the stages: regularized towards the last w, then a constant w
FREE, HELD = 6, 9
#: sweeps of a GPU thread regularized towards a constant w
SWEEPS = 24
#: largest number of unknowns of all stages for whose matrix a GPU thread has memory
COUPLED_UP_TO = 40
#: largest number of unknowns of all stages for whose `Complement` a GPU thread has memory
SWEPT_UP_TO = 200


@dataclass(frozen=True)
class DAE:
    """A system of differential-algebraic equations.

    Fields:
        f: (t, y (n,), y' (n,), w (m,)) -> (n + m,).
        depth: number of integrations p of each of the last m rows.
        free_diagonal: (m,) diagonal of the Schur complement for free bodies; 0 if unknown.
        kinematic, ggl: as in `Sizes`.
    """

    f: Callable[..., jax.Array]
    depth: tuple[int, ...]
    free_diagonal: jax.Array
    kinematic: int
    ggl: int = 0


class StepStart(NamedTuple):
    """Start of a step, where the Jacobian is evaluated; also the initial guess of its stages."""

    t: Any
    y: jax.Array
    rate: jax.Array
    w: jax.Array


class StageProblem(NamedTuple):
    """Data of the stage equations."""

    h: Any
    t: jax.Array  # (s,)
    y: jax.Array  # (s, n)
    weights: MethodMatrix
    start: StepStart
    free_diagonal: jax.Array
    read: tuple  # closed-over values of f


class StageRates(NamedTuple):
    """Solution of the stage equations.

    Fields:
        rates: (s, n) rates of the state at the stages.
        w: (s, m) algebraic unknowns at the stages.
        ok: whether the iteration converged. If not, the values are the guess.
    """

    rates: jax.Array
    w: jax.Array
    ok: jax.Array


def solve(
    equations: DAE, h: Any, t: jax.Array, y: jax.Array, weights: MethodMatrix, start: StepStart
) -> StageRates:
    """Solve the equations of the stages at times t (s,), from base values y (s, n)."""
    s, n = y.shape
    f, read = jax.closure_convert(equations.f, *start)
    # jit traces f only once
    system = StageSystem(jax.jit(f), Sizes(n, equations.kinematic, equations.depth, equations.ggl))
    start, free_diagonal = jax.lax.stop_gradient((start, equations.free_diagonal))

    @eqx.filter_custom_jvp
    def root(problem):
        blocks = system.invert_start(problem)
        return batch_first((system.find_root(blocks, problem), blocks))

    @root.def_jvp
    def _(primals, tangents):
        found, blocks = root(*primals)  # calls the function with this rule
        x = found[:-1].reshape(s, -1)
        _, change = eqx.filter_jvp(lambda problem: system.residual(x, problem), primals, tangents)
        rate = jnp.append(-system.solve_linear(x, change, blocks, *primals), 0 * found[-1])
        # the solution does not depend on the blocks
        return (found, blocks), batch_first((rate, jax.tree.map(jnp.zeros_like, blocks)))

    found, _ = root(StageProblem(h, t, y, weights, start, free_diagonal, tuple(read)))
    x = found[:-1].reshape(s, -1)
    return StageRates(x[:, :n], x[:, n:], found[-1] > 0)


def damp_error(equations: DAE, gamma_h: Any, start: StepStart, raw: jax.Array) -> jax.Array:
    """Damp an error estimate `raw` (n,) of y by an implicit Euler step of the linearized equations.
    The step gamma h removes stiff parts and parts across the constraints."""
    start, free_diagonal = jax.lax.stop_gradient((start, equations.free_diagonal))
    n, one = raw.size, weight(jnp.ones((), raw.dtype))
    system = StageSystem(equations.f, Sizes(n, 0, equations.depth, 0))
    slopes = system.slope(*start, ())[None]
    residual = system.weighted(matvec(slopes[0, :, :n], raw)[None], gamma_h, one)
    change = -Factored(system.matrix(slopes, gamma_h, one), free_diagonal).solved(residual)
    return raw + gamma_h * change[0, :n]


@dataclass(frozen=True)
class StageSystem:
    """The stage equations f(t, y, rates, w, *read) = 0 of a step, in x = (rates, w)."""

    f: Callable[..., jax.Array]
    sizes: Sizes

    @property
    def n(self) -> int:
        return self.sizes.n

    def stages(self, x: jax.Array, at: StageProblem) -> tuple[jax.Array, ...]:
        """Return time, y, rates and algebraic unknowns w of each stage, from x = (rates, w)."""
        k, w = x[:, : self.n], x[:, self.n :]
        return at.t, at.y + at.h * weighted_sums(at.weights.a, k), k, w

    def residual(self, x: jax.Array, at: StageProblem) -> jax.Array:
        """Return the stage equations (s, n + m) at x = (rates, w), with scaled algebraic rows."""
        out = each(lambda *stage: self.f(*stage, *at.read), *self.stages(x, at))
        return self.weighted(out, at.h, at.weights)

    def weighted(self, rows: jax.Array, h: Any, weights: MethodMatrix) -> jax.Array:
        """Multiply the algebraic rows, the last m of (s, n + m, ...), by (h A)^-depth."""
        back, parts, at = weights.inverse / h, [rows[:, : self.n]], self.n
        for p in self.sizes.depth:
            row = rows[:, at]
            for _ in range(p):
                row = weighted_sums(back, row)
            parts.append(row[:, None])
            at += 1
        return jnp.concatenate(parts, 1)

    def slope(self, t, y, rate, w, read) -> jax.Array:
        """Return the Jacobian (n + m, 2 n + m) of f by (y, y', w) at a point."""
        one = jnp.eye(2 * self.n + len(w), dtype=y.dtype)
        return each(self.push(t, y, rate, w, read), one).T

    def push(self, t, y, rate, w, read) -> Callable[[jax.Array], jax.Array]:
        """Return the function d -> df, the derivative of f along a change d (2 n + m,) of (y, y',
        w)."""
        n = self.n

        def f(z):
            return self.f(t, z[:n], z[n : 2 * n], z[2 * n :], *read)

        at = jnp.concatenate([y, rate, w])
        return lambda d: jax.jvp(f, (at,), (d,))[1]

    def invert_start(self, at: StageProblem) -> Blocks:
        """Compute blocks of an approximate inverse of the matrix of all stages, at the start."""
        push = self.push(*at.start, at.read)
        return simplified(push, self.sizes, at.h, at.weights, at.free_diagonal)

    def push_residual(self, x: jax.Array, at: StageProblem) -> Callable[[jax.Array], jax.Array]:
        """Return the function d -> derivative of the residual at x along a change d of x."""
        return lambda d: jax.jvp(lambda x: self.residual(x, at), (x,), (d,))[1]

    def complement(self, x: jax.Array, shared: Simplified, at: StageProblem) -> Complement:
        """Compute the Schur complement of the algebraic unknowns w of all stages, at x."""
        near = rank_tolerance("stages", at.y.dtype)
        push = self.push_residual(x, at)
        return complement(push, shared.free, at.free_diagonal, len(at.y), self.n, near)

    def stage_matrix(self, x: jax.Array, at: StageProblem) -> Matrix:
        """Compute the matrix of all stages at x."""
        slopes = jax.vmap(functools.partial(self.slope, read=at.read))(*self.stages(x, at))
        return self.matrix(slopes, at.h, at.weights)

    def matrix(self, slopes: jax.Array, h: Any, weights: MethodMatrix) -> Matrix:
        """Assemble d residual / d (rates, w) from the slopes at the stages (s, n + m, 2 n + m)."""
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

    def find_root(self, blocks: Blocks, at: StageProblem) -> jax.Array:
        """Return the root and a flag 1 in one array; the guess and 0 if the iteration fails."""
        h, y, start = at.h, at.y, at.start
        s, n, size = len(y), self.n, jnp.maximum(1.0, jnp.abs(y).max())
        guess = jnp.broadcast_to(jnp.concatenate([start.rate, start.w]), (s, n + len(start.w)))
        shared = Simplified(self.sizes, *jax.lax.stop_gradient((h, at.weights, blocks)))

        def chord(x: jax.Array, target: jax.Array, count: jax.Array) -> tuple:
            return shared.solved(self.residual(x, at)), target

        def newton(x: jax.Array, target: jax.Array, count: jax.Array) -> tuple:
            near = rank_tolerance("stages", y.dtype)
            matrix = Factored(self.stage_matrix(x, at), at.free_diagonal, near)
            target = jnp.where(count < FREE, x[:, n:], target)
            return matrix.once(self.residual(x, at), x[:, n:] - target), target

        def sweep(x: jax.Array, target: jax.Array, count: jax.Array) -> tuple:
            target = jnp.where(count < FREE, x[:, n:], target)
            S = self.complement(x, shared, at)
            return x - S.sweep(lambda x: self.residual(x, at), shared.free, x, target), target

        def found(step: Callable, done: jax.Array, x: jax.Array, most: int) -> tuple:
            """Iterate Newton steps. Return whether they converged, and the root, else the guess."""

            def once(carry: tuple) -> tuple:
                x, target, before, count, _ = carry
                dx, target = step(x, target, count)
                x = x - dx
                scale = jnp.maximum(size, jnp.abs(h * x[:, :n]).max())
                now = jnp.abs(h * dx[:, :n]).max() / scale
                return x, target, now, count + 1, is_rounding(now, before, count)

            def more(carry: tuple) -> jax.Array:
                *_, before, count, done = carry
                return ~done & (count < most) & ((count == 0) | jnp.isfinite(before))

            first = x, x[:, n:], jnp.full((), jnp.inf, y.dtype), jnp.array(0), done
            x, *_, done = jax.lax.while_loop(more, once, first)
            return done, jnp.where(done, x, guess)

        done, x = found(chord, jnp.array(False), guess, MAX_STEPS)
        done, x = choose_by_memory(
            guess.size,
            lambda done, x: found(newton, done, x, FREE + HELD),
            lambda done, x: found(sweep, done, x, FREE + SWEEPS),
            lambda done, x: (done, x),
        )(done, x)
        return jnp.append(x, done.astype(y.dtype))

    def solve_linear(
        self, x: jax.Array, change: jax.Array, blocks: Blocks, at: StageProblem
    ) -> jax.Array:
        """Solve for the change (s, n + m) of x that causes a given change of the residual. The
        iteration uses the matrix at the start of the step. If it does not converge, the matrices at
        the stages are used."""
        shared = Simplified(self.sizes, *jax.lax.stop_gradient((at.h, at.weights, blocks)))

        def back(d: jax.Array) -> jax.Array:
            return jax.linear_transpose(shared.solved, d)(d)[0]

        def free_back(d: jax.Array) -> jax.Array:
            return jax.linear_transpose(shared.free, d)(d)[0]

        def by(nearly: Callable, transposed: bool) -> Callable:
            def solved(push: Callable, b: jax.Array) -> jax.Array:
                found, done = solve_by_corrections(push, nearly, b, self.n)

                def directly(_: tuple) -> tuple:
                    matrix = self.stage_matrix(x, at)
                    matrix = matrix.transposed if transposed else matrix
                    eps = rank_tolerance("regularization", b.dtype)
                    return Factored(matrix, at.free_diagonal, eps).solved(b), jnp.array(True)

                def by_sweeps(_: tuple) -> tuple:
                    S = self.complement(x, shared, at)
                    S = S._replace(transposed=transposed)
                    exact, ok = solve_by_sweeps(
                        push, S, free_back if transposed else shared.free, b, self.n
                    )
                    return jnp.where(ok, exact, jnp.nan), jnp.array(True)

                def once(f: Callable) -> Callable:
                    # a loop instead of a branch, because a batch would execute both branches
                    return lambda *carry: jax.lax.while_loop(lambda x: ~x[1], f, carry)[0]

                def fail(found: jax.Array, done: jax.Array) -> jax.Array:
                    return jnp.where(done, found, jnp.nan)

                choose = choose_by_memory(x.size, once(directly), once(by_sweeps), fail)
                return choose(found, done)

            return solved

        push = self.push_residual(x, at)
        return jax.lax.custom_linear_solve(push, change, by(shared.solved, False), by(back, True))


def choose_by_memory(
    unknowns: int, f: Callable, smaller: Callable, otherwise: Callable
) -> Callable:
    """Return f, which needs a matrix of all unknowns, or another function on a small GPU."""
    if unknowns <= COUPLED_UP_TO:
        return f
    on_gpu = smaller if unknowns <= SWEPT_UP_TO else otherwise
    return lambda *args: jax.lax.platform_dependent(*args, cuda=on_gpu, default=f)


def solve_by_corrections(push: Callable, nearly: Callable, b: jax.Array, n: int) -> tuple:
    """Solve push(x) = b by corrections nearly(b - push(x)). Return x and whether it converged."""
    return add_corrections(lambda x: nearly(b - push(x)), b, n)


def solve_by_sweeps(push: Callable, S: Complement, free: Callable, b: jax.Array, n: int) -> tuple:
    """Solve push(x) = b by `Complement.sweep` of S. Return x and whether it converged."""
    noise = SWEPT_NOISE[b.dtype.itemsize]
    return add_corrections(
        lambda x: S.sweep(lambda x: push(x) - b, free, x, x[:, n:]) - x, b, n, noise
    )


def add_corrections(
    correction: Callable, b: jax.Array, n: int, noise: float = LINEAR_NOISE
) -> tuple:
    """Add corrections correction(x) to x, from 0, until the first n columns change by rounding.
    Return x and whether it converged."""
    eps = float(jnp.finfo(b.dtype).eps)

    def once(at: tuple) -> tuple:
        x, before, count, _ = at
        dx = correction(x)
        x = x + dx
        size = jnp.abs(x[:, :n]).max()
        now = jnp.abs(dx[:, :n]).max() / jnp.where(size > 0, size, 1.0)
        return x, now, count + 1, is_rounding(now, before, count, noise * eps)

    def more(at: tuple) -> jax.Array:
        _, before, count, done = at
        return ~done & (count < MAX_STEPS) & ((count == 0) | jnp.isfinite(before))

    start = jnp.zeros_like(b), jnp.full((), jnp.inf, b.dtype), jnp.array(0), jnp.array(False)
    x, _, _, done = jax.lax.while_loop(more, once, start)
    return x, done


def is_rounding(
    now: jax.Array, before: jax.Array, count: jax.Array, noise: float | None = None
) -> jax.Array:
    """Return whether the next correction is rounding, or corrections stall below `noise`."""
    eps = float(jnp.finfo(now.dtype).eps)
    noise = STALLED_BELOW[now.dtype.itemsize] if noise is None else noise
    ratio = now / jnp.where(before > 0, before, 1.0)
    falling = (count > 0) & (ratio < STALLED)
    coming = now * jnp.where(falling, ratio / (1 - jnp.where(falling, ratio, 0.0)), 1.0)
    stalled = (count > 0) & (ratio >= STALLED) & (now <= noise)
    return (coming <= ROUNDING * eps) | stalled
