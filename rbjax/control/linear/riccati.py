"""The linear-quadratic problem of finite horizon, solved by a backward Riccati recursion.

    minimise    sum_(k<N) 1/2 x'Qx + q'x + 1/2 u'Ru + r'u + x'Su  +  1/2 x_N'Q_N x_N + q_N'x_N
    subject to  x_(k+1) = A x_k + B u_k + d_k

The cost to go is 1/2 x'Px + p'x plus a constant. With P+ and p+ of the next knot,

    H = R + B'P+B,  G = S' + B'P+A,  g = r + B'(p+ + P+d),    u = -H^-1 G x - H^-1 g
    P = Q + A'P+A - G'H^-1 G,        p = q + A'(p+ + P+d) - G'H^-1 g

The minimum exists if every H is positive definite.
Source: Bryson & Ho, *Applied Optimal Control*, 5; Anderson & Moore, *Optimal Control: Linear
Quadratic Methods*, 2; Tassa, Erez & Todorov, IROS 2012 (affine terms).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular

from rbjax.arguments import instance, integer
from rbjax.control.linear.arguments import check_regulator, weight_matrix
from rbjax.control.products import product
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_array

MADE = "a LinearQuadratic, such as rb.control.linear.constant_problem returns"


@displayed
class LinearQuadratic(NamedTuple):
    """A linear-quadratic problem of N steps, n states and m controls.

    A, B, d: dynamics dx+ = A dx + B du + d; (N, n, n), (N, n, m), (N, n).
    Q, q: cost 1/2 dx'Q dx + q'dx, with terminal cost, (N + 1, n, n) and (N + 1, n).
    R, r: cost 1/2 du'R du + r'du, (N, m, m) and (N, m).
    S: cost dx'S du, (N, n, m).
    """

    A: jax.Array
    B: jax.Array
    d: jax.Array
    Q: jax.Array
    q: jax.Array
    R: jax.Array
    r: jax.Array
    S: jax.Array


@displayed
class Gains(NamedTuple):
    """The solution: du = -K dx - k, and the cost to go 1/2 dx'P dx + p'dx + constant.

    K: gains, (N, m, n).
    k: feedforward terms, (N, m).
    P: (N + 1, n, n).
    p: (N + 1, n).
    success: false if the Hessian with respect to the controls of some step is not positive
        definite, or a result is not finite, (). K and k of such a step are 0, and its P and p are
        copies from the next knot, so nothing is nan.
    """

    K: jax.Array
    k: jax.Array
    P: jax.Array
    p: jax.Array
    success: jax.Array


@jax.custom_jvp
def definite_factor(H: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return L of H = L L' and whether H is positive definite; if not, L is the identity matrix."""
    L = jax.lax.linalg.cholesky(H, symmetrize_input=False)
    ok = jnp.isfinite(L).all()
    return jnp.where(ok, L, jnp.eye(H.shape[-1], dtype=H.dtype)), ok


@definite_factor.defjvp
def _definite_factor_jvp(primals, tangents):
    (H,), (dH,) = primals, tangents
    L, ok = definite_factor(H)
    half = solve_triangular(L, (dH + dH.T) / 2, lower=True)
    W = solve_triangular(L, half.T, lower=True)
    dL = product(L, jnp.tril(W) - jnp.diag(jnp.diag(W)) / 2)
    return (L, ok), (jnp.where(ok, dL, 0.0), jnp.zeros(ok.shape, jax.dtypes.float0))


def propagate_hessian(V: jax.Array, A: jax.Array, B: jax.Array) -> tuple[jax.Array, ...]:
    """Return A'VA, B'VB and B'VA, the Hessian of the cost to go before a step."""
    VA = product(V, A)
    return product(A.T, VA), product(B.T, product(V, B)), product(B.T, VA)


def backward(problem: LinearQuadratic) -> Gains:
    """Compute the gains and the cost to go of every knot by the Riccati recursion.

        K = H^-1 (S' + B'P A),   k = H^-1 (r + B'(p + P d)),   H = R + B'P B

    Args:
        problem: one sample.

    Returns:
        `Gains`; du = -K dx - k.

    Compatible with `rb.threads`, one problem per thread. Differentiable in both modes.

    Raises:
        InputError: not a `LinearQuadratic`.

    Source: Bryson & Ho, *Applied Optimal Control*, 5.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.control.linear import backward, constant_problem
        >>> one = jnp.eye(1)
        >>> gains = backward(constant_problem(one, one, one, one, 20))
        >>> round(float(gains.K[0, 0, 0]), 6)  # the golden ratio less one
        0.618034
    """
    instance("backward", "problem", problem, LinearQuadratic, MADE)
    end = problem.Q[-1], problem.q[-1]
    ok = jnp.isfinite(end[0]).all() & jnp.isfinite(end[1]).all()
    P, p = (jnp.where(ok, x, jnp.zeros_like(x)) for x in end)
    P = (P + P.T) / 2
    steps = problem._replace(Q=problem.Q[:-1], q=problem.q[:-1])

    def back(carry, given):
        P, p, ok = carry
        z = given
        APA, BPB, BPA = propagate_hessian(P, z.A, z.B)
        ahead = p + product(P, z.d)
        H, G = z.R + BPB, z.S.T + BPA
        L, good = definite_factor((H + H.T) / 2)
        both = jnp.concatenate([G, (z.r + product(z.B.T, ahead))[:, None]], 1)
        half = solve_triangular(L, both, lower=True)
        K = solve_triangular(L, half, lower=True, trans=1)
        Y, y = half[:, :-1], half[:, -1]
        new = z.Q + APA - product(Y.T, Y)
        new, slope = (new + new.T) / 2, z.q + product(z.A.T, ahead) - product(Y.T, y)
        good &= jnp.isfinite(new).all() & jnp.isfinite(slope).all() & jnp.isfinite(K).all()
        P, p = jnp.where(good, new, P), jnp.where(good, slope, p)
        K = jnp.where(good, K, 0.0)
        return (P, p, ok & good), (K[:, :-1], K[:, -1], P, p)

    carry, (K, k, Ps, ps) = jax.lax.scan(back, (P, p, ok), steps, reverse=True)
    Ps, ps = jnp.concatenate([Ps, P[None]]), jnp.concatenate([ps, p[None]])
    return Gains(K, k, Ps, ps, carry[2])


def roll(problem: LinearQuadratic, gains: Gains, start: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute states (N + 1, n) and controls (N, m) of the closed loop from a start.

        du = -K dx - k,    dx+ = A dx + B du + d

    Args:
        problem: one sample.
        gains: the result of `backward`.
        start: dx_0 (n,).

    Returns:
        dx (N + 1, n), du (N, m).

    Raises:
        InputError: not a `LinearQuadratic`, another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.control.linear import backward, constant_problem, roll
        >>> one = jnp.eye(1)
        >>> problem = constant_problem(one, one, one, one, 2)
        >>> x, u = roll(problem, backward(problem), jnp.ones(1))
        >>> [round(float(y), 2) for y in x.ravel()]
        [1.0, 0.4, 0.2]
    """
    instance("roll", "problem", problem, LinearQuadratic, MADE)
    instance("roll", "gains", gains, Gains, "Gains, such as rb.control.linear.backward returns")
    start = check_array("roll", "start", start, problem.A.shape[-1:])
    return roll_linear(problem.A, problem.B, problem.d, -gains.K, -gains.k, start)


def roll_linear(
    A: jax.Array, B: jax.Array, d: jax.Array, K: jax.Array, k: jax.Array, first: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return x (N + 1, n) and u (N, m) of x+ = A x + B u + d, u = k + K x."""

    def step(x: jax.Array, given: tuple) -> tuple[jax.Array, tuple]:
        A, B, d, K, k = given
        u = k + product(K, x)
        return product(A, x) + product(B, u) + d, (x, u)

    last, (x, u) = jax.lax.scan(step, first, (A, B, d, K, k))
    return jnp.concatenate([x, last[None]]), u


def constant_problem(
    A: Any, B: Any, Q: Any, R: Any, horizon: int, terminal: Any = None, S: Any = None
) -> LinearQuadratic:
    """Build the problem of N equal steps without affine terms, such as an LQR of finite horizon.

    Args:
        A: (n, n).
        B: (n, m).
        Q: (n, n), symmetric; or the weights (n,).
        R: (m, m), symmetric; or the weights (m,).
        horizon: N.
        terminal: Q_N, (n, n) or (n,); Q if None.
        S: (n, m); 0 if None.

    Returns:
        `LinearQuadratic`.

    Raises:
        InputError: shapes, values that are not finite, Q or R that is not symmetric, or a horizon
            below 1.

    Example:
        >>> from rbjax.control.linear import backward, constant_problem
        >>> backward(constant_problem([[1.0]], [[1.0]], [1.0], [1.0], 5)).K.shape
        (5, 1, 1)
    """
    where = "constant_problem"
    integer(where, "horizon", horizon, least=1)
    A, B, Q, R, S = check_regulator(where, A, B, Q, R, S)
    end = Q if terminal is None else weight_matrix(where, "terminal", terminal, A.shape[0])
    A, B = (jnp.broadcast_to(x, (horizon, *x.shape)) for x in (A, B))
    return constant_weights(A, B, Q, R, end.astype(A.dtype), S)


def constant_weights(
    A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, end: jax.Array, S: Any = None
) -> LinearQuadratic:
    """Build the problem of A (N, n, n) and B (N, n, m) with the same weights at each step."""
    N, n, m = B.shape

    def each(x: jax.Array) -> jax.Array:
        return jnp.broadcast_to(x, (N, *x.shape))

    S = jnp.zeros_like(B) if S is None else each(S)
    x, u = jnp.zeros((N + 1, n), B.dtype), jnp.zeros((N, m), B.dtype)
    Qs = jnp.concatenate([each(Q), end[None]])
    return LinearQuadratic(A, B, x[:-1], Qs, x, each(R), u, S)
