"""The linear KKT system of an optimal control problem, solved along the horizon in O(N).

    [ H   G' ] [ w ]   [ r ]      w = (x_0, u_0, x_1, ..., x_N): H of blocks Q_k, S_k, R_k
    [ G   0  ] [ y ] = [ s ]      rows of G: A_k x_k + B_k u_k - x_{k+1},  C_k x_k + D_k u_k,  E x_N

y = (l, nu) are costates and multipliers. Active rows enter the recursion as penalties rho |C x + D
u - s|^2 / 2, so they need not be independent. Each step of iterative refinement r <- r - K z
multiplies the error by a factor of order 1/rho.
Source: Wright, *Interior point methods for optimal control of discrete time systems*, 1993.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.control.linear.riccati import propagate_hessian, roll_linear
from rbjax.control.products import product

TURNS = 4  # steps of iterative refinement


def transpose_product(A: jax.Array, B: jax.Array) -> jax.Array:
    """Return A' B."""
    return product(A.T, B)


class KKTUnknowns(NamedTuple):
    """Unknowns of the KKT system, or a right-hand side.

    x: states, (N + 1, n).
    u: controls, (N, m).
    l: costates, (N + 1, n).
    path, end: multipliers of the constraints, (N, c) and (e,).
    """

    x: jax.Array
    u: jax.Array
    l: jax.Array
    path: jax.Array
    end: jax.Array


class Saddle(NamedTuple):
    """Blocks of the KKT matrix, and masks of 0 and 1.

    fixed: fixed coordinates of x_0, (n,).
    free: free controls, (N, m); the others are zero.
    path, end: active rows, (N, c) and (e,); the others have no multiplier.
    """

    A: jax.Array
    B: jax.Array
    Q: jax.Array  # (N + 1, n, n)
    S: jax.Array
    R: jax.Array
    C: jax.Array
    D: jax.Array
    E: jax.Array
    fixed: jax.Array
    free: jax.Array
    path: jax.Array
    end: jax.Array


class KKTFactor(NamedTuple):
    """The factors of a KKT matrix by the Riccati recursion."""

    K: jax.Array  # (N, m, n)
    inverse: jax.Array  # (N, m, m), of the control Hessians
    V: jax.Array  # (N + 1, n, n)
    first: jax.Array  # the inverse of V_0 in the free coordinates
    rho: jax.Array  # ()
    ok: jax.Array  # (), whether all inverted matrices were positive definite


def apply_masks(e: Saddle) -> Saddle:
    """Return the blocks of the KKT matrix with masked rows and columns set to zero."""
    free = e.free[:, None, :]
    return e._replace(
        B=e.B * free, S=e.S * free, R=e.R * free * e.free[:, :, None],
        C=e.C * e.path[:, :, None], D=e.D * e.path[:, :, None] * free, E=e.E * e.end[:, None],
    )  # fmt: skip


def multiply(e: Saddle, z: KKTUnknowns) -> KKTUnknowns:
    """Return the product K z of the KKT matrix, from masked blocks, and a vector."""
    x, after, l = z.x[:-1], z.x[1:], z.l[1:]
    mul, mulT = jax.vmap(product), jax.vmap(lambda M, v: product(M.T, v))
    gx = mul(e.Q[:-1], x) + mul(e.S, z.u) + mulT(e.A, l) + mulT(e.C, z.path)
    before = jnp.concatenate([(e.fixed * z.l[0])[None], z.l[1:-1]])
    last = product(e.Q[-1], z.x[-1]) + product(e.E.T, z.end) - z.l[-1]
    gu = mulT(e.S, x) + mul(e.R, z.u) + mulT(e.B, l) + mulT(e.D, z.path) + (1 - e.free) * z.u
    gap = mul(e.A, x) + mul(e.B, z.u) - after
    opening = (1 - e.fixed) * z.l[0] - e.fixed * z.x[0]
    return KKTUnknowns(
        jnp.concatenate([gx - before, last[None]]), gu, jnp.concatenate([opening[None], gap]),
        mul(e.C, x) + mul(e.D, z.u) + (1 - e.path) * z.path,
        product(e.E, z.x[-1]) + (1 - e.end) * z.end,
    )  # fmt: skip


def factorise(e: Saddle) -> KKTFactor:
    """Factor the masked KKT matrix by a Riccati recursion."""
    dtype = e.Q.dtype
    rho = jnp.asarray(float(jnp.finfo(dtype).eps) ** -0.4, dtype)

    def back(carry: tuple, knot: tuple) -> tuple:
        V, ok = carry
        A, B, Q, S, R, C, D, free = knot
        AVA, BVB, BVA = propagate_hessian(V, A, B)
        Quu = R + BVB + rho * transpose_product(D, D) + jnp.diag(1 - free)
        Qux = S.T + BVA + rho * transpose_product(D, C)
        inverse, fine = _inverse(Quu)
        K = -product(inverse, Qux)
        W = Q + AVA + rho * transpose_product(C, C) + transpose_product(Qux, K)
        W = 0.5 * (W + W.T)
        return (W, ok & fine), (K, inverse, W)

    V_N = e.Q[-1] + rho * transpose_product(e.E, e.E)
    knots = (e.A, e.B, e.Q[:-1], e.S, e.R, e.C, e.D, e.free)
    found: tuple = jax.lax.scan(back, (V_N, jnp.asarray(True)), knots, reverse=True)
    (V, ok), (K, inverse, Vs) = found
    open_ = 1 - e.fixed
    first, fine = _inverse(V * open_[:, None] * open_ + jnp.diag(e.fixed))
    return KKTFactor(K, inverse, jnp.concatenate([Vs, V_N[None]]), first, rho, ok & fine)


def _inverse(H: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the inverse of a symmetric matrix, and whether it is positive definite. Eigenvalues
    are bounded away from zero."""
    tiny = jnp.finfo(H.dtype).eps
    values, vectors = jnp.linalg.eigh(H)
    least = tiny * jnp.maximum(jnp.abs(values).max(), tiny)
    held = jnp.where(values < 0, jnp.minimum(values, -least), jnp.maximum(values, least))
    return product(vectors / held, vectors.T), (values > least).all()


def solve(e: Saddle, f: KKTFactor, r: KKTUnknowns) -> KKTUnknowns:
    """Solve K z = r for z, with iterative refinement."""

    def refine(_: Any, z: KKTUnknowns) -> KKTUnknowns:
        left = jax.tree.map(jnp.subtract, r, multiply(e, z))
        return jax.tree.map(jnp.add, z, _solve_penalised(e, f, left))

    return jax.lax.fori_loop(0, TURNS + 1, refine, jax.tree.map(jnp.zeros_like, r))


def _solve_penalised(e: Saddle, f: KKTFactor, r: KKTUnknowns) -> KKTUnknowns:
    """Solve the KKT system, regularized by -1/rho on the diagonal of active rows."""
    rho = f.rho
    rows, ends = rho * e.path * r.path, rho * e.end * r.end

    def back(v: jax.Array, knot: tuple) -> tuple:
        A, B, C, D, V, K, inverse, qx, qu, gap, rows = knot
        there = v - product(V, gap)  # the gradient after the step at x = 0, u = 0
        Qu = product(B.T, there) - qu - product(D.T, rows)
        Qx = product(A.T, there) - qx - product(C.T, rows)
        return Qx + product(K.T, Qu), (-product(inverse, Qu), v)

    v_N = -r.x[-1] - product(e.E.T, ends)
    given = (e.A, e.B, e.C, e.D, f.V[1:], f.K, f.inverse, r.x[:-1], r.u, r.l[1:], rows)
    found: tuple = jax.lax.scan(back, v_N, given, reverse=True)
    v, (k, vs) = found
    x0 = -e.fixed * r.l[0]
    slope = product(f.V[0], x0) + v
    x0 = x0 - (1 - e.fixed) * product(f.first, (1 - e.fixed) * slope)
    l0 = e.fixed * (product(f.V[0], x0) + v) + (1 - e.fixed) * r.l[0]

    x, u = roll_linear(e.A, e.B, -r.l[1:], f.K, k, x0)
    mul = jax.vmap(product)
    l = jnp.concatenate([l0[None], mul(f.V[1:], x[1:]) + vs])
    path = rho * (mul(e.C, x[:-1]) + mul(e.D, u)) - rows + (1 - e.path) * r.path
    end = rho * product(e.E, x[-1]) - ends + (1 - e.end) * r.end
    return KKTUnknowns(x, u, l, path, end)
