"""Algebraic Riccati equations: their stabilising solution, by doubling and Newton's method.

    continuous  A'P + PA + Q - (PB + S) R^-1 (PB + S)' = 0,              K = R^-1 (PB + S)'
    discrete    A'PA - P + Q - (A'PB + S) (R + B'PB)^-1 (A'PB + S)' = 0, K = (R + B'PB)^-1 (..)'

1. Doubling. S is eliminated from A and Q, and G = B R^-1 B'. From F = A, P = Q, k doublings give
the cost to go of 2^k time steps. Cayley's transform makes a continuous equation discrete.

     F <- F (1 + G P)^-1 F,  G <- G + F (1 + G P)^-1 G F',  P <- P + F'P (1 + G P)^-1 F

2. If its gain is not stabilising, use the gain for costs Q = q 1, R = r 1 instead.
3. Newton's method from that gain. Each step solves a Lyapunov equation for the P of the closed
loop, and computes the gain of P.
4. Two steps of iterative refinement with the residual in 1.5 times the digits (`Double`).

The derivative solves one Lyapunov equation of the closed loop, by the implicit function theorem.
Source: Chu, Fan, Lin & Wang, Int. J. Control 77, 2004; Chu, Fan & Lin, Linear Algebra Appl. 396,
2005 (Cayley); Kleinman, IEEE TAC 13, 1968; Hewer, IEEE TAC 16, 1971 (Newton); Ogita, Rump & Oishi,
SIAM J. Scientific Computing 26, 2005 (digits).
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import cho_solve, solve_triangular

from rbjax.compiling import compiled
from rbjax.control.linear.lyapunov_equation import is_stable, solve_stable
from rbjax.control.products import definite_factor, product
from rbjax.control.status import LinearStatus, first_of
from rbjax.display import displayed


class Double(NamedTuple):
    """A double-word number hi + lo, with hi the sum rounded to one word."""

    hi: jax.Array
    lo: jax.Array

    @classmethod
    def of(cls, x: jax.Array) -> Double:
        return cls(x, jnp.zeros_like(x))

    @property
    def T(self) -> Double:
        return Double(self.hi.T, self.lo.T)

    def __neg__(self) -> Double:
        return Double(-self.hi, -self.lo)

    def __add__(self, other: Double) -> Double:  # type: ignore[override]
        s, rest = _sum(self.hi, other.hi)
        return Double(*_sum(s, rest + (self.lo + other.lo)))

    def __sub__(self, other: Double) -> Double:
        return self + -other

    def __matmul__(self, other: Double) -> Double:
        upper, lower = _halves(self.hi), _halves(other.hi)

        def add(k: jax.Array, found: Double) -> Double:
            ah, al, a, a_lo = (x[:, k, None] for x in (*upper, *self))
            bh, bl, b, b_lo = (x[k, None] for x in (*lower, *other))
            rest = (ah * bl + al * bh) + (al * bl + (a * b_lo + a_lo * b))
            return found + Double(ah * bh, rest)

        zero = jnp.zeros((self.hi.shape[0], other.hi.shape[1]), self.hi.dtype)
        return jax.lax.fori_loop(0, self.hi.shape[1], add, Double.of(zero))


def _sum(a: jax.Array, b: jax.Array) -> tuple[jax.Array, jax.Array]:
    s = a + b
    t = s - a
    return s, (a - (s - t)) + (b - t)


def _halves(a: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Split each number into the upper and the lower half of its digits."""
    bits = np.dtype(f"u{a.dtype.itemsize}")
    lower = (jnp.finfo(a.dtype).nmant + 2) // 2
    mask = np.asarray(~((1 << lower) - 1) & (2 ** (8 * a.dtype.itemsize) - 1), bits)
    high = jax.lax.bitcast_convert_type(jax.lax.bitcast_convert_type(a, bits) & mask, a.dtype)
    return high, a - high


TURNS = 60  # maximum number of doublings
REFINED = 2  # the first step leaves the square of the error
NEWTON = 60  # Newton steps; a start far above the solution is halved by each
EDGE = 0.02  # a relative change of P by a step that means no convergence
Problem = tuple[jax.Array, jax.Array, jax.Array, jax.Array, jax.Array]


@displayed
class Regulator(NamedTuple):
    """A regulator of infinite horizon; K and P are 0 if there is no solution.

    K: gain of u = -K x, (m, n).
    P: cost matrix; the minimum cost is x'Px, (n, n).
    residual: largest entry of the residual of the Riccati equation over its largest term, ().
    error: bound of the relative rounding error of P, ().
    status: a `LinearStatus`.
    acceleration: v' at the state and controls of `lqr_at`, zero at an equilibrium, (nv,); None for
        `lqr`.
    """

    K: jax.Array
    P: jax.Array
    residual: jax.Array
    error: jax.Array
    status: Any
    acceleration: jax.Array | None = None

    @property
    def success(self) -> jax.Array:
        """True if there is a solution."""
        return self.status == LinearStatus.success


@functools.partial(compiled, static_argnums=5)
def riccati(
    A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, S: jax.Array, discrete: bool
) -> Regulator:
    """Compute the stabilising solution of a Riccati equation, for arrays of one float dtype."""
    problem = (A, B, (Q + Q.T) / 2, (R + R.T) / 2, S)
    finite = jnp.isfinite(jnp.concatenate([x.ravel() for x in problem])).all()
    n, m = B.shape
    blank = (-jnp.eye(n), jnp.zeros((n, m)), jnp.eye(n), jnp.eye(m), jnp.zeros((n, m)))
    if discrete:
        blank = (jnp.zeros((n, n)), *blank[1:])
    problem = jax.tree.map(lambda x, y: jnp.where(finite, x, y.astype(x.dtype)), problem, blank)
    P, codes = _solution(discrete, *problem)
    started, converged, definite = codes
    found = finite & started & converged & definite
    P = jnp.where(found, P, 0.0)
    K, _ = gain(discrete, problem, P)
    K = jnp.where(found, K, 0.0)
    off, size = remainder(discrete, problem, P)
    error = jax.lax.stop_gradient(_rounding(discrete, problem, P, K))
    status = first_of(
        (~finite, LinearStatus.not_finite),
        (~definite, LinearStatus.indefinite_control_cost),
        (~started, LinearStatus.not_stabilisable),
        (~converged, LinearStatus.no_stabilising_solution),
    )
    residual, error = (
        jnp.where(ok, x, jnp.inf) for ok, x in ((finite, jnp.abs(off).max() / size), (found, error))
    )
    return Regulator(K, P, residual, error, status)


def gain(discrete: bool, problem: Problem, P: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the feedback gain K of a solution P, and whether the control Hessian is positive
    definite."""
    A, B, _, R, S = problem
    PB = product(P, B)
    if discrete:
        L, ok = definite_factor(R + (product(B.T, PB) + product(PB.T, B)) / 2)
        return cho_solve((L, True), product(PB.T, A) + S.T), ok
    L, ok = definite_factor(R)
    return cho_solve((L, True), (PB + S).T), ok


def remainder(discrete: bool, problem: Problem, P: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the residual (n, n) of the Riccati equation, and the size of its largest term."""
    A, B, Q, R, S = problem
    PA, PB = product(P, A), product(P, B)
    H = R + product(B.T, PB) if discrete else R
    L, _ = definite_factor((H + H.T) / 2)
    G = S.T + (product(PB.T, A) if discrete else PB.T)
    Y = solve_triangular(L, G, lower=True)
    square = product(Y.T, Y)
    terms = [product(A.T, PA), -P] if discrete else [PA, PA.T]
    size = sum(jnp.abs(x).max() for x in (*terms, Q, square))
    return terms[0] + terms[1] + Q - square, jnp.maximum(size, jnp.finfo(P.dtype).tiny)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solution(discrete: bool, *matrices: jax.Array) -> tuple[jax.Array, tuple[jax.Array, ...]]:
    """Return P and three flags: a stabilising start exists, Newton converged, the Hessian is
    definite."""
    A, B, Q, R, S = matrices
    problem = A, B, Q, R, S
    K, started = _start(discrete, problem)
    P, converged, definite = _newton(discrete, problem, K, started)
    refined = _refine(discrete, problem, P)
    good = started & converged & definite & jnp.isfinite(refined).all()
    P = jnp.where(good, refined, P)
    return P, (started, converged, definite)


@_solution.defjvp
def _solution_jvp(discrete, problem, changes):
    P, codes = _solution(discrete, *problem)
    good = functools.reduce(jnp.logical_and, codes)
    P = jnp.where(good, P, 0.0)
    K, _ = gain(discrete, problem, P)
    closed = problem[0] - product(problem[1], K)
    M = jax.jvp(lambda *z: remainder(discrete, z, P)[0], problem, changes)[1]
    dP, _ = solve_stable(closed.T, (M + M.T) / 2, discrete)
    dead = tuple(jnp.zeros(x.shape, jax.dtypes.float0) for x in codes)
    return (P, codes), (jnp.where(good, dP, 0.0), dead)


def _start(discrete: bool, problem: Problem) -> tuple[jax.Array, jax.Array]:
    """Return a stabilising gain, and whether it exists."""
    A, B, Q, R, S = problem
    n, m = B.shape
    one, none = jnp.eye(n, dtype=A.dtype), jnp.zeros_like(S)
    q, r = (jnp.abs(x).max() for x in (Q, R))
    q, r = (jnp.where(x > 0, x, 1.0) for x in (q, r))
    easy = (A, B, q * one, r * jnp.eye(m, dtype=A.dtype), none)
    both = jax.tree.map(lambda *x: jnp.stack(x), problem, easy)

    def of(z: Problem) -> tuple[jax.Array, jax.Array]:
        P = _cost_to_go_by_doubling(discrete, z)
        K, ok = gain(discrete, z, P)
        return K, ok & _stabilises(discrete, A, B, K)

    K, ok = jax.vmap(of)(both)
    return jnp.where(ok[0], K[0], jnp.where(ok[1], K[1], 0.0)), ok.any()


def _stabilises(discrete: bool, A: jax.Array, B: jax.Array, K: jax.Array) -> jax.Array:
    closed = A - product(B, K)
    finite = jnp.isfinite(closed).all()
    closed = jnp.where(finite, closed, 0.0)
    return finite & is_stable(closed, discrete)


def _cost_to_go_by_doubling(discrete: bool, problem: Problem) -> jax.Array:
    """Return the cost to go after many time steps, by doubling. It need not converge."""
    A, B, Q, R, S = problem
    n = A.shape[0]
    one = jnp.eye(n, dtype=A.dtype)
    L, ok = definite_factor(R)
    half = solve_triangular(L, jnp.concatenate([B.T, S.T], 1), lower=True)
    b, s = half[:, :n], half[:, n:]
    F, G, P = A - product(b.T, s), product(b.T, b), Q - product(s.T, s)
    scale = jnp.ones((), A.dtype)
    if not discrete:
        scale = jnp.sqrt(_norm(P) / _norm(G))
        scale = jnp.where(jnp.isfinite(scale) & (scale > 0), scale, 1.0)
        G, P = G * scale, P / scale
        # a shift above every eigenvalue of the Hamiltonian matrix, so the inverses below exist
        g = _norm(F) + jnp.sqrt(_norm(G) * _norm(P)) + jnp.finfo(A.dtype).tiny
        inverse = jnp.linalg.inv(F - g * one)
        GI = product(inverse, G)
        W = jnp.linalg.inv(F.T - g * one + product(P, GI))
        P0 = product(W, product(P, inverse))
        F, G, P = one + 2 * g * W.T, 2 * g * product(GI, W), 2 * g * P0
        G, P = (G + G.T) / 2, (P + P.T) / 2
    eps = jnp.finfo(A.dtype).eps

    def going(carry):
        _, _, P, change, k = carry
        return (k < TURNS) & (change > eps * jnp.abs(P).max()) & jnp.isfinite(change)

    def turn(carry):
        F, G, P, _, k = carry
        M = jnp.linalg.solve(one + product(G, P), jnp.concatenate([F, product(G, F.T)], 1))
        MF, MG = M[:, :n], M[:, n:]
        more = product(F.T, product(P, MF))
        G = G + product(F, MG)
        new = P + (more + more.T) / 2
        kept = jnp.isfinite(new).all()  # otherwise keep the last finite P
        change = jnp.where(kept, jnp.abs(more).max(), jnp.inf)
        return product(F, MF), (G + G.T) / 2, jnp.where(kept, new, P), change, k + 1

    begin = (F, G, P, jnp.asarray(jnp.finfo(A.dtype).max, A.dtype), 0)
    P = jax.lax.while_loop(going, turn, begin)[2]
    return jnp.where(ok, P * scale, jnp.nan)


def _norm(A: jax.Array) -> jax.Array:
    return jnp.sqrt(jnp.abs(A).sum(0).max() * jnp.abs(A).sum(1).max())


def _newton(discrete: bool, problem: Problem, K: jax.Array, started: jax.Array) -> Any:
    """Return the cost matrix P by Newton's method from the gain K.

    Also return whether it converged and is stabilising, and whether the control Hessian is
    definite.
    """
    A, B, Q, R, S = problem
    eps = jnp.finfo(A.dtype).eps

    def evaluated(K: jax.Array) -> tuple[jax.Array, jax.Array]:
        closed = A - product(B, K)
        SK = product(S, K)
        cost = Q + product(K.T, product(R, K)) - SK - SK.T
        P, stable = solve_stable(closed.T, cost, discrete)
        return (P + P.T) / 2, stable

    def going(carry):
        *_, k, done, good, _ = carry
        return (k < NEWTON) & ~done & good

    def turn(carry):
        P, K, off, k, *_ = carry
        new, stable = evaluated(K)
        gained, definite = gain(discrete, problem, new)
        left, size = remainder(discrete, problem, new)
        rest = jnp.abs(left).max() / size
        good = stable & definite & jnp.isfinite(new).all() & jnp.isfinite(gained).all()
        # at the edge of stability each step halves P: linear convergence to a double root
        sizes = jnp.abs(jnp.diag(new))
        moved = jnp.abs(jnp.diag(new - P)) > EDGE * jnp.maximum(sizes, 1e3 * eps * sizes.max())
        better = good & ((rest < off) | (off > 1e4 * eps))
        done = good & (k > 0) & (rest < 1e3 * eps) & ((rest >= off / 2) | (rest <= 2 * eps))
        return (
            jnp.where(better, new, P), jnp.where(better, gained, K), jnp.where(better, rest, off),
            k + 1, done, good, moved.any(),
        )  # fmt: skip

    inf = jnp.asarray(jnp.inf, A.dtype)
    begin = (jnp.zeros_like(Q), K, inf, 0, jnp.asarray(False), started, jnp.asarray(True))
    P, _, off, _, _, good, moved = jax.lax.while_loop(going, turn, begin)
    K, definite = gain(discrete, problem, P)
    good &= (off < jnp.sqrt(eps)) & ~moved & _stabilises(discrete, A, B, K)
    return P, good, definite


def _refine(discrete: bool, problem: Problem, P: jax.Array) -> jax.Array:
    """Improve P by Newton steps on the Riccati equation, whose residual is computed in double
    words."""
    rounded = (*problem, gain(discrete, problem, P)[0])
    A, B, Q, R, S, K = (Double.of(x) for x in rounded)
    closed, SK = A - B @ K, S @ K
    cost = Q - (SK + SK.T) + K.T @ (R @ K)
    for _ in range(REFINED):
        at = Double.of(P)
        moved = closed.T @ at
        off = (moved @ closed - at if discrete else moved + moved.T) + cost
        more, _ = solve_stable(closed.hi.T, (off.hi + off.hi.T) / 2, discrete)
        P = P + more
    return P


def _rounding(discrete: bool, problem: Problem, P: jax.Array, K: jax.Array) -> jax.Array:
    """Return a bound of the relative rounding error of P."""
    A, B, Q, R, _ = problem
    closed, size = A - product(B, K), jnp.abs
    H = R + product(B.T, product(P, B)) if discrete else R
    square, PA = product(size(K).T, product(size(H), size(K))), product(size(P), size(A))
    terms = product(size(A).T, PA) + size(P) if discrete else PA + PA.T
    rows = jnp.diag((terms + size(Q) + square).sum(1)) * jnp.finfo(P.dtype).eps
    X, stable = solve_stable(closed.T, rows, discrete)
    error = size(X).max() / jnp.maximum(size(P).max(), jnp.finfo(P.dtype).tiny)
    refined = error**2 + 4 * jnp.finfo(P.dtype).eps
    return jnp.where(stable, jnp.minimum(error, refined), jnp.inf)
