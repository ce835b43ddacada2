"""Matrices of stages with algebraic unknowns, solved by the Schur complement S of these.

    [K  C] [k]   [r]            S = D - B K^-1 C,     S w = b,     b = r_w - B K^-1 r
    [B  D] [w] = [r_w]
S is singular where rows say the same twice and where rows vanish. Where all stages share a matrix,
S is nearly G M^-1 G^T, so it is not negative and is regularized (`rbjax.lanes.factorization`) by
eps of its diagonal and e of a diagonal without vanishing rows. Where each stage has its own, a
row's gradient may turn round from one to the next, and S has eigenvalues of either sign:
(S + E)^-1 may be larger than S^-1. Then w is that of least squares,

    min |S w - b|^2 + eps^2 |w - c|^2,      c what w was, or zero
in which a singular value s of S counts by s / (s^2 + eps^2). (Levenberg 1944; Hairer & Wanner,
*Solving Ordinary Differential Equations II*, VII.2: the matrices of constrained motion.)
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import lu_factor, lu_solve, solve_triangular

from rbjax.lanes import matvec
from rbjax.lanes.factorization import damped, least

#: (b, c) -> w
Solve = Callable[[jax.Array, jax.Array], jax.Array]


class Matrix(NamedTuple):
    """Blocks: rows of the differential equations, then of the algebraic ones; columns of the rates,
    then of w."""

    rates: jax.Array
    w: jax.Array
    row_rates: jax.Array
    row_w: jax.Array

    @property
    def transposed(self) -> Matrix:
        return Matrix(self.rates.T, self.row_rates.T, self.w.T, self.row_w.T)


class Factored:
    """Solves by the Schur complement of the w, regularized.

    usual (m,): the diagonal of S, of a stage, where no row vanishes; 0 where that is not known.
    least_squares: eps of these; None: E is added.
    """

    def __init__(self, matrix: Matrix, usual: jax.Array, least_squares: float | None = None):
        self._matrix = matrix
        eps, vanishing, self._again = damped(matrix.w.dtype)
        self._rates = lu_factor(matrix.rates)
        self._response = lu_solve(self._rates, matrix.w)
        S = matrix.row_w - _product(matrix.row_rates, self._response)
        D = jnp.abs(jnp.diagonal(S))
        B = jnp.tile(usual, len(D) // max(len(usual), 1))
        if least_squares:
            rounding = float(jnp.finfo(D.dtype).eps)
            size = D + least(D, B, 1.0, rounding / least_squares)
            self._solved = _by_least_squares(S, jnp.where(size > 0, size, 1.0), least_squares)
        else:
            E = eps * D + least(D, B, vanishing)
            self._solved = _by_shift(S, jnp.where(E > 0, E, 1.0))

    def once(self, r: jax.Array, c: jax.Array | float = 0.0) -> jax.Array:
        """x (s, n + m) of matrix x = r, regularized towards w = c (s, m)."""
        s = len(r)
        n = len(self._matrix.rates) // s
        k = lu_solve(self._rates, r[:, :n].ravel())
        b = r[:, n:].ravel() - matvec(self._matrix.row_rates, k)
        w = self._solved(b, jnp.broadcast_to(c, r[:, n:].shape).ravel())
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


def _by_shift(S: jax.Array, E: jax.Array) -> Solve:
    """w of (S + E) w = b + E c."""
    factors = lu_factor(S + jnp.diag(E))
    return lambda b, c: lu_solve(factors, b + E * c)


def _by_least_squares(S: jax.Array, size: jax.Array, eps: float) -> Solve:
    """w of least |S w - b|^2 + eps^2 |w - c|^2, scaled so that `size` is 1."""
    r, one = 1.0 / jnp.sqrt(size), jnp.eye(len(S), dtype=S.dtype)
    Q, R = jnp.linalg.qr(jnp.concatenate([r[:, None] * S * r, eps * one]))

    def solved(b: jax.Array, c: jax.Array) -> jax.Array:
        due = matvec(Q.T, jnp.concatenate([r * b, eps * c / r]))
        return r * solve_triangular(R, due)

    return solved


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)
