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

from rbjax.arguments import flag, instance, integer
from rbjax.control.linear.arguments import check_regulator, weight_matrix
from rbjax.control.linear.parallel_riccati import costs_to_go
from rbjax.control.products import definite_factor, product
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_array


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

    @classmethod
    def constant(
        cls, A: Any, B: Any, Q: Any, R: Any, horizon: int, terminal: Any = None, S: Any = None
    ) -> LinearQuadratic:
        """Build the problem of N equal steps without affine terms, an LQR of finite horizon.

        Args:
            A: (n, n).
            B: (n, m).
            Q: (n, n), symmetric; or the weights (n,).
            R: (m, m), symmetric; or the weights (m,).
            horizon: N.
            terminal: Q_N, (n, n) or (n,); Q if None.
            S: (n, m); 0 if None.
        """
        where = "LinearQuadratic.constant"
        integer(where, "horizon", horizon, least=1)
        A, B, Q, R, S = check_regulator(where, A, B, Q, R, S)
        end = Q if terminal is None else weight_matrix(where, "terminal", terminal, A.shape[0])
        A, B = (jnp.broadcast_to(x, (horizon, *x.shape)) for x in (A, B))
        return constant_weights(A, B, Q, R, end.astype(A.dtype), S)

    def roll(self, gains: Gains, start: Any) -> tuple[jax.Array, jax.Array]:
        """Compute states dx (N + 1, n) and controls du (N, m) of the closed loop du = -K dx - k,
        from the start dx_0 (n,)."""
        fix = "Gains, such as rb.control.linear.backward returns"
        instance("roll", "gains", gains, Gains, fix)
        start = check_array("roll", "start", start, self.A.shape[-1:])
        return roll_linear(self.A, self.B, self.d, -gains.K, -gains.k, start)


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


def propagate_hessian(V: jax.Array, A: jax.Array, B: jax.Array) -> tuple[jax.Array, ...]:
    """Return A'VA, B'VB and B'VA, the Hessian of the cost to go before a step."""
    VA = product(V, A)
    return product(A.T, VA), product(B.T, product(V, B)), product(B.T, VA)


def backward(problem: LinearQuadratic, *, parallel: bool = False) -> Gains:
    """Compute the gains and the cost to go of every knot by the Riccati recursion.

        K = H^-1 (S' + B'P A),   k = H^-1 (r + B'(p + P d)),   H = R + B'P B

    Args:
        problem: one sample.
        parallel: whether to take log2 N sequential batched products instead of N, with 3 log2 N
            times the arithmetic, for a device that is not fully used. R must be positive definite.
            Without success all K and k are 0.

    Returns:
        `Gains`; du = -K dx - k.

    Compatible with `rb.threads`, one problem per thread. Differentiable in both modes.

    Raises:
        InputError: not a `LinearQuadratic`.

    Source: Bryson & Ho, *Applied Optimal Control*, 5; Särkkä & García-Fernández 2023 (parallel).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.control.linear import LinearQuadratic, backward
        >>> one = jnp.eye(1)
        >>> gains = backward(LinearQuadratic.constant(one, one, one, one, 20))
        >>> round(float(gains.K[0, 0, 0]), 6)  # the golden ratio less one
        0.618034
    """
    fix = "a LinearQuadratic, such as LinearQuadratic.constant returns"
    instance("backward", "problem", problem, LinearQuadratic, fix)
    steps = problem._replace(Q=problem.Q[:-1], q=problem.q[:-1])
    if flag("backward", "parallel", parallel):
        P, p, ok = costs_to_go(problem)
        K, k, _, _, good = jax.vmap(_step)(steps, P[1:], p[1:])
        ok &= good.all()
        return Gains(jnp.where(ok, K, 0.0), jnp.where(ok, k, 0.0), P, p, ok)
    end = problem.Q[-1], problem.q[-1]
    ok = jnp.isfinite(end[0]).all() & jnp.isfinite(end[1]).all()
    P, p = (jnp.where(ok, x, jnp.zeros_like(x)) for x in end)
    P = (P + P.T) / 2

    def back(carry: tuple, z: LinearQuadratic) -> tuple:
        P, p, ok = carry
        K, k, new, slope, good = _step(z, P, p)
        good &= jnp.isfinite(new).all() & jnp.isfinite(slope).all()
        P, p = jnp.where(good, new, P), jnp.where(good, slope, p)
        K, k = jnp.where(good, K, 0.0), jnp.where(good, k, 0.0)
        return (P, p, ok & good), (K, k, P, p)

    found: tuple = jax.lax.scan(back, (P, p, ok), steps, reverse=True)
    carry, (K, k, Ps, ps) = found
    Ps, ps = jnp.concatenate([Ps, P[None]]), jnp.concatenate([ps, p[None]])
    return Gains(K, k, Ps, ps, carry[2])


def _step(z: LinearQuadratic, P: jax.Array, p: jax.Array) -> tuple[jax.Array, ...]:
    """Return K, k, P and p of a step from P and p of the next knot, and whether H is positive
    definite and the gains are finite."""
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
    return K[:, :-1], K[:, -1], new, slope, good & jnp.isfinite(K).all()


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
