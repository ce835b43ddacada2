"""Stage equations with algebraic unknowns w, solved by the Schur complement S of w.

    [K  C] [k]   [r]            S = D - B K^-1 C,     S w = b,     b = r_w - B K^-1 r
    [B  D] [w] = [r_w]
S is singular if rows are redundant or vanish. If all stages share a matrix, S is close to the
positive semidefinite matrix G M^-1 G^T, and E is added to it (`rbjax.lanes.factorization`). If each
stage has its own matrix, the gradient of a row may change sign between stages, and S is indefinite.
Then w is the solution of

    min |S w - b|^2 + eps^2 |w - c|^2,      c the previous w, or zero

`Complement` needs less memory, for GPU threads. It replaces K^-1 by the blocks at the start of the
step (`simplified`), and computes S column by column from derivatives of the equations. One sweep is

    k <- k - F r(k, w), twice;    w <- w - (S + E)^-1 (b(k, w) + E (w - c)),     F close to K^-1

Source: Levenberg 1944; Hairer & Wanner, *Solving Ordinary Differential Equations II*, VII.2; Benzi,
Golub & Liesen, *Numerical solution of saddle point problems*, 2005, 8.1.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import lu_factor, lu_solve, solve_triangular

from rbjax.lanes import inverse, matvec
from rbjax.lanes.arrays import each
from rbjax.lanes.factorization import diagonal_floor, regularization

#: (b, c) -> w, the solution regularized towards c
Solve = Callable[[jax.Array, jax.Array], jax.Array]


class Matrix(NamedTuple):
    """The four blocks of the Newton matrix of all stages: equations and rows by rates and by w."""

    rates: jax.Array
    w: jax.Array
    row_rates: jax.Array
    row_w: jax.Array

    @property
    def transposed(self) -> Matrix:
        return Matrix(self.rates.T, self.row_rates.T, self.w.T, self.row_w.T)


class Factored:
    """A Newton matrix of all stages, factored by its regularized Schur complement.

    Args:
        matrix: blocks of the matrix.
        free_diagonal: (m,) diagonal of the Schur complement for free bodies, of one stage; 0 if
            unknown.
        least_squares: eps of the least-squares problem; None adds a shift E instead.
    """

    def __init__(
        self, matrix: Matrix, free_diagonal: jax.Array, least_squares: float | None = None
    ):
        self._matrix = matrix
        eps, vanishing, self._refinements = regularization(matrix.w.dtype)
        self._rates = lu_factor(matrix.rates)
        self._response = lu_solve(self._rates, matrix.w)
        S = matrix.row_w - _product(matrix.row_rates, self._response)
        D = jnp.abs(jnp.diagonal(S))
        B = jnp.tile(free_diagonal, len(D) // max(len(free_diagonal), 1))
        if least_squares:
            rounding = float(jnp.finfo(D.dtype).eps)
            size = D + diagonal_floor(D, B, 1.0, rounding / least_squares)
            self._solve = _by_least_squares(S, jnp.where(size > 0, size, 1.0), least_squares)
        else:
            E = eps * D + diagonal_floor(D, B, vanishing)
            self._solve = _by_shift(S, jnp.where(E > 0, E, 1.0))

    def once(self, r: jax.Array, c: jax.Array | float = 0.0) -> jax.Array:
        """Solve matrix x = r for x (s, n + m), without refinement. w is regularized towards c (s,
        m)."""
        s = len(r)
        n = len(self._matrix.rates) // s
        k = lu_solve(self._rates, r[:, :n].ravel())
        b = r[:, n:].ravel() - matvec(self._matrix.row_rates, k)
        w = self._solve(b, jnp.broadcast_to(c, r[:, n:].shape).ravel())
        k = k - matvec(self._response, w)
        return jnp.concatenate([k.reshape(s, -1), w.reshape(s, -1)], 1)

    def solved(self, r: jax.Array) -> jax.Array:
        """Solve matrix x = r, with refinements that remove the error of the regularization."""
        x = self.once(r)
        for _ in range(self._refinements):
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
    """Factor S + E. Return the function (b, c) -> w that solves (S + E) w = b + E c."""
    factors = lu_factor(S + jnp.diag(E))
    return lambda b, c: lu_solve(factors, b + E * c)


def _by_least_squares(S: jax.Array, size: jax.Array, eps: float) -> Solve:
    """Factor the problem min |S w - b|^2 + eps^2 |w - c|^2, scaled so that the diagonal `size` of S
    becomes 1. Return the function (b, c) -> w."""
    r, one = 1.0 / jnp.sqrt(size), jnp.eye(len(S), dtype=S.dtype)
    Q, R = jnp.linalg.qr(jnp.concatenate([r[:, None] * S * r, eps * one]))

    def solve(b: jax.Array, c: jax.Array) -> jax.Array:
        due = matvec(Q.T, jnp.concatenate([r * b, eps * c / r]))
        return r * solve_triangular(R, due)

    return solve


def _product(a: jax.Array, b: jax.Array) -> jax.Array:
    return jnp.matmul(a, b, precision=jax.lax.Precision.HIGHEST)


#: function of x (s, n + m) or of its change; F is a function of (s, n)
Function = Callable[[jax.Array], jax.Array]


class Complement(NamedTuple):
    """A regularized Schur complement that needs little memory.

    Fields:
        inverse: (s m, s m) transpose of (S + E)^-1.
        E: (s m,) regularization.
        transposed: whether it solves the transposed equations. A GPU thread would have to copy a
            matrix to transpose it.
    """

    inverse: jax.Array
    E: jax.Array
    transposed: bool = False

    def sweep(self, residual: Function, free: Function, x: jax.Array, c: jax.Array) -> jax.Array:
        """Improve the solution x of residual(x) = 0 by one sweep, regularized towards w = c."""
        m = c.shape[1]
        n = x.shape[1] - m
        x, rows = _relax(residual, free, x, n)
        w = x[:, n:]
        b = rows.ravel() + self.E * (w - c).ravel()
        axis = 1 if self.transposed else 0
        precision = jax.lax.Precision.HIGHEST
        dw = jax.lax.dot_general(self.inverse, b, (((axis,), (0,)), ((), ())), precision)
        return jnp.concatenate([x[:, :n], w - dw.reshape(w.shape)], 1)


def complement(
    push: Function, free: Function, free_diagonal: jax.Array, s: int, n: int, near: float
) -> Complement:
    """Compute the Schur complement of s stages.

    Args:
        push: derivative of the equations along a change of x.
        free: approximate inverse of K.
        free_diagonal: (m,) diagonal of S for free bodies, of one stage.
        s: number of stages.
        n: number of rates.
        near: E relative to the diagonal of S and to `free_diagonal`.
    """
    m = len(free_diagonal)

    def column(j: jax.Array) -> tuple:
        one = (jnp.arange(s * m) == j).astype(free_diagonal.dtype)
        d = jnp.concatenate([jnp.zeros((s, n), free_diagonal.dtype), one.reshape(s, m)], 1)
        S = _relax(push, free, d, n)[1].ravel()
        E = near * (jnp.abs(one * S).sum() + free_diagonal[j % m])
        E = jnp.where(E > 0, E, 1.0)
        return S + E * one, E

    S, E = each(column, jnp.arange(s * m))
    return Complement(inverse(S)[0], E)


def _relax(residual: Function, free: Function, x: jax.Array, n: int) -> tuple[jax.Array, jax.Array]:
    """Improve the rates of x by two approximate Newton steps with constant w. Return x, and the
    residuals of the constraint rows before the last step."""

    def improve(x: jax.Array, _: None) -> tuple[jax.Array, jax.Array]:
        r = residual(x)
        return jnp.concatenate([x[:, :n] - free(r[:, :n]), x[:, n:]], 1), r[:, n:]

    found, rows = jax.lax.scan(improve, x, None, length=2)
    return found, rows[-1]
