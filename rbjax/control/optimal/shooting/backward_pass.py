"""The backward pass of differential dynamic programming: gains from a second-order expansion.

    Qxx = Q + A'V'A,  Quu = R + B'V'B,  Qux = S' + B'V'A,  Qx = q + A'v',  Qu = r + B'v'
    du = k + K dx,   k = argmin over the box,   K = -Quu^-1 Qux in the free controls
    V = Qxx + Qxu K,   v = Qx + Qxu k

The gaps of steps enter v (Mastalli et al. 2020). Projected Newton steps solve the quadratic program
in the box (Bertsekas 1982; Tassa, Mansard & Todorov 2014).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.control.linear.riccati import propagate_hessian
from rbjax.control.optimal.shooting.expansion import Quadratic
from rbjax.control.products import in_registers, product
from rbjax.lanes.arrays import matvec

TURNS = 20  # maximum number of Newton steps; m entries usually require at most m + 2
HALVINGS = np.array([0.5**k for k in range(8)])


class BoxSolution(NamedTuple):
    """The solution of a quadratic program in a box.

    d: minimum, (m,).
    free: 1 for entries within the box, 0 at a bound, (m,).
    factor: lower Cholesky factor of H in the free entries and the identity elsewhere, (m, m).
    ok: true if H is positive definite in the free entries.
    """

    d: jax.Array
    free: jax.Array
    factor: jax.Array
    ok: jax.Array


def box_qp(H: jax.Array, g: jax.Array, low: jax.Array, high: jax.Array) -> BoxSolution:
    """Minimise d'H d / 2 + g'd over the box low <= d <= high, for definite H (m, m), low < high."""
    L = factor_of(H)
    d = -solved(L, g)  # often within the box already
    return jax.lax.cond(
        ((d >= low) & (d <= high)).all(),
        lambda: BoxSolution(d, jnp.ones_like(g), L, is_factor(L)),
        lambda: _projected(H, g, low, high),
    )


def box_gains(
    H: jax.Array, g: jax.Array, G: jax.Array, low: jax.Array, high: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Return the minimum d of `box_qp`, the gains K = -H^-1 G (m, n), and whether H is definite.

    Rows of K at an active bound are 0.
    """
    both, ok = gains(H, g, G)
    d = both[:, -1]
    inside = ((d >= low) & (d <= high)).all()

    def held(_: tuple) -> tuple:
        box = _projected(H, g, low, high)
        free = box.free[:, None]
        K = -free * solved(box.factor, free * G)
        return jnp.concatenate([K, box.d[:, None]], 1), box.ok, jnp.asarray(True)

    # a loop of at most one turn; `cond` would copy the results of both branches
    both, ok, _ = jax.lax.while_loop(lambda now: ~now[2], held, (both, ok, inside))
    return both[:, -1], both[:, :-1], ok


def gains(H: jax.Array, g: jax.Array, G: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Compute -H^-1 G (m, n) and -H^-1 g (m,) as one array, and whether H is positive definite."""
    L = factor_of(H)
    return solved(L, -jnp.concatenate([G, g[:, None]], 1)), is_factor(L)


def _projected(H: jax.Array, g: jax.Array, low: jax.Array, high: jax.Array) -> BoxSolution:
    dtype = g.dtype
    eye = jnp.eye(len(g), dtype=dtype)
    halvings = jnp.asarray(HALVINGS, dtype)

    def cost(d: jax.Array) -> jax.Array:
        return (d * (g + 0.5 * matvec(H, d))).sum(-1)

    def free_of(d: jax.Array) -> jax.Array:
        slope = g + matvec(H, d)
        held = ((d <= low) & (slope > 0)) | ((d >= high) & (slope < 0))
        return jnp.where(held, 0.0, 1.0).astype(dtype)

    def turn(now: tuple) -> tuple:
        d, _, _, turns, _ = now
        free = free_of(d)
        L = factor_of(H * free[:, None] * free + eye * (1 - free))
        step = -free * solved(L, free * (g + matvec(H, d)))
        tries = jnp.clip(d + halvings[:, None] * step, low, high)
        costs = jax.vmap(cost)(tries)
        best = jnp.argmin(costs)
        better = costs[best] < cost(d)
        new = jnp.where(better, tries[best], d)
        # a full step with an unchanged active set is the minimum
        done = ~better | ((best == 0) & (free_of(new) == free).all())
        return new, free, L, turns + 1, done

    d = jnp.clip(jnp.zeros_like(g), low, high)
    begin = (d, jnp.ones_like(g), eye, 0, jnp.asarray(False))
    d, free, L, *_ = jax.lax.while_loop(lambda now: (now[3] < TURNS) & ~now[4], turn, begin)
    return BoxSolution(d, free, L, is_factor(L))


def factor_of(H: jax.Array) -> jax.Array:
    """Return the Cholesky factor L of H = L L', from the lower triangle of H."""
    return jax.lax.linalg.cholesky(H, symmetrize_input=False)


def is_factor(L: jax.Array) -> jax.Array:
    """Return whether the factorisation succeeded; otherwise L is nan."""
    return jnp.isfinite(jnp.diagonal(L)).all()


def solved(L: jax.Array, b: jax.Array) -> jax.Array:
    """Return (L L')^-1 b for a vector or the columns of a matrix."""
    return jax.scipy.linalg.cho_solve((L, True), b)


class Feedback(NamedTuple):
    """The step du = k + K dx at each knot, and the value function."""

    K: jax.Array  # (N, m, n)
    k: jax.Array  # (N, m)
    V: jax.Array  # (N + 1, n, n), the Hessian of the value function
    v: jax.Array  # (N + 1, n), its gradient, gap included
    first: jax.Array  # dx0 (n,)
    slope: jax.Array  # (), of the cost along the step
    curvature: jax.Array  # ()
    square: jax.Array  # (), the squared projected gradient, without regularisation
    ok: jax.Array  # (), whether all control Hessians were positive definite


class Bounds(NamedTuple):
    """Bounds low and high of du, (N, m) each."""

    low: jax.Array
    high: jax.Array


def backward_pass(
    A: jax.Array, B: jax.Array, gaps: jax.Array, path: Quadratic, end: Quadratic,
    bounds: Bounds | None, first: tuple | None, reg: jax.Array, h: Any = None,
) -> Feedback:  # fmt: skip
    """Compute the gains and the value function.

    A: (N, n, n).
    B: (N, n, m).
    gaps: (N + 1, n); the first is from the first knot to the start.
    path, end: costs of the knots with controls (N, ...), and of the end.
    bounds: of du; None for none.
    first: (free, low, high) of the first knot, (n,) each: mask of its free coordinates, and bounds
        of dx0; None if it is fixed.
    reg: regularisation, added to the diagonals of the control Hessians and of V.
    h: the step size, if dq+ = dq + h dv+; None for other systems.
    """
    m, n = path.r.shape[-1], end.q.shape[0]
    eye_u, eye_x = jnp.eye(m, dtype=reg.dtype), jnp.eye(n, dtype=reg.dtype)

    def back(carry: tuple, knot: tuple) -> tuple:
        V, v, l, slope, curvature, square, ok = jax.tree.map(in_registers, carry)
        A, B, gap, cost, bound = jax.tree.map(in_registers, knot)
        if h is None:
            Qxx, Quu, Qux, Qx, Qu = propagate_value(V, v, A, B)
        else:
            Qxx, Quu, Qux, Qx, Qu = propagate_value_by_velocities(V, v, A, B, h)
        descent = cost.r + product(B.T, l)
        if bound is not None:
            descent = projected_gradient(descent, *bound)
        square = square + (descent * descent).sum()
        l = cost.q + product(A.T, l)
        Qxx, Quu, Qux = cost.Q + Qxx, cost.R + Quu + reg * eye_u, cost.S.T + Qux
        Qx, Qu = cost.q + Qx, cost.r + Qu
        if bound is None:
            both, fine = gains(Quu, Qu, Qux)
            k, K = both[:, -1], both[:, :-1]
        else:
            k, K, fine = box_gains(Quu, Qu, Qux, *bound)
        V = Qxx + reg * eye_x + product(Qux.T, K)
        V = 0.5 * (V + V.T)
        v = Qx + product(Qux.T, k)
        v_gap = v + product(V, gap)
        slope = slope + (Qu * k).sum() + (v_gap * gap).sum()
        curvature = curvature + (k * product(Quu, k)).sum() - (gap * (v_gap - v)).sum()
        return (V, v_gap, l, slope, curvature, square, ok & fine), (K, k, V, v_gap)

    last = gaps[-1]
    v = end.q + product(end.Q, last)
    curvature = -(last * product(end.Q, last)).sum()
    zero = jnp.zeros((), reg.dtype)
    begin = (end.Q + reg * eye_x, v, end.q, (v * last).sum(), curvature, zero, jnp.asarray(True))
    knots = (A, B, gaps[:-1], path, bounds)
    found: Any = jax.lax.scan(back, begin, knots, reverse=True)
    (V, v, l, slope, curvature, square, ok), (K, k, Vs, vs) = found
    dx0 = gaps[0]
    if first is not None:
        free, low, high = first
        H = V * free[:, None] * free + eye_x * (1 - free)
        huge = jnp.finfo(reg.dtype).max
        box = box_qp(H, free * v, jnp.maximum(low, -huge), jnp.minimum(high, huge))
        step = free * jnp.where(box.ok, box.d, 0.0)
        opening = free * projected_gradient(l, low, high)
        square = square + (opening * opening).sum()
        slope = slope + (v * step).sum()
        curvature = curvature + (step * product(H, step)).sum()
        dx0, ok = dx0 + step, ok & box.ok
    Vs, vs = (jnp.concatenate([x, y[None]]) for x, y in ((Vs, end.Q), (vs, begin[1])))
    return Feedback(K, k, Vs, vs, dx0, slope, curvature, square, ok)


def projected_gradient(gradient: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Return the gradient, with 0 in entries whose descent violates a bound of the step."""
    pressed = ((low >= 0) & (gradient > 0)) | ((high <= 0) & (gradient < 0))
    return jnp.where(pressed, 0.0, gradient)


def propagate_value(V: jax.Array, v: jax.Array, A: jax.Array, B: jax.Array) -> tuple:
    """Return A'VA, B'VB, B'VA, A'v and B'v."""
    return *propagate_hessian(V, A, B), product(A.T, v), product(B.T, v)


def propagate_value_by_velocities(
    V: jax.Array, v: jax.Array, A: jax.Array, B: jax.Array, h: Any
) -> tuple:
    """Compute `propagate_value` at half the cost, if dv+ = [C D] dx + E du and dq+ = dq + h dv+.

    A = T (1 + [0; F]),  B = T [0; E],  T = [1 h; 0 1],  F = [C D - 1]
    """
    n = len(v) // 2
    F, E = A[n:] - jnp.eye(n, 2 * n, n, dtype=A.dtype), B[n:]
    q, c, w = V[:n, :n], V[:n, n:], V[n:, n:]
    w = w + h * (c + c.T) + h * h * q
    columns = jnp.concatenate([c + h * q, w])  # columns of T'VT for the velocities
    rows = jnp.concatenate([q, V[n:, :n] + h * q])
    W = jnp.concatenate([rows, columns], 1) + product(columns, F)
    slope = v[n:] + h * v[:n]
    Qx = jnp.concatenate([v[:n], slope]) + product(F.T, slope)
    return (
        W + product(F.T, W[n:]), product(E.T, product(w, E)), product(E.T, W[n:]), Qx,
        product(E.T, slope),
    )  # fmt: skip
