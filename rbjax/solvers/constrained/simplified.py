"""The matrix of simplified Newton iterations of constrained motion, inverted block by block.

    equations  kinematic  u' - v = 0                            unknowns  u'
                or, GGL   M (u' - v) - G^T mu = 0
               dynamic    f(u, v, x, v', x') - B^T w = 0                  v', x'
               rows       of u or v, with gradients B                     w
               GGL rows   of u, with gradients G                          mu
All stages share the matrix at the start of the step. A method's matrix A has the real form

    A T = T diag(r_1, ...,  [ x  -y]
                            [ y   x], ...)
so the matrix of all stages decomposes into one matrix per eigenvalue z / h, of the size of one
stage. It is real for a real eigenvalue and complex for a pair. Elimination of u' gives

    K(z) = M + z D + z^2 K       of v', x': masses, dampings, stiffnesses
    S(z) = B K(z)^-1 B^T         of w
    S_mu = G M^-1 G^T            of mu
Terms of relative size h times a rate of the motion are neglected: the derivatives of gradients and
of attitudes, and the effect of mu on v'. A singular S is regularized (`rbjax.lanes.factorization`).

Source: Butcher, *BIT* 16, 1976; Hairer & Wanner, *Solving Ordinary Differential Equations II*,
IV.8.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import inverse
from rbjax.lanes.arrays import each
from rbjax.lanes.factorization import diagonal_floor, regularization
from rbjax.solvers.steps import weighted_sums


class Spectrum(NamedTuple):
    """Real form of the matrix A of a method.

    Fields:
        to: (s, s) matrix T.
        back: (s, s) inverse of T.
        real: (r,) real eigenvalues, in the order of the columns of T.
        pairs: (c, 2) eigenvalues with a positive imaginary part, in the order of the columns of T.
    """

    to: Any
    back: Any
    real: Any
    pairs: Any


def spectrum(a: np.ndarray) -> Spectrum:
    """Compute the real form of an invertible matrix with distinct eigenvalues."""
    values, vectors = np.linalg.eig(a)
    size = np.abs(values).max()
    real = [k for k in range(len(a)) if abs(values[k].imag) <= 1e-12 * size]
    above = [k for k in range(len(a)) if k not in real and values[k].imag > 0]
    columns = [vectors[:, k].real for k in real]
    for k in above:  # A (p - i q) = (x + i y) (p - i q)
        columns += [vectors[:, k].real, -vectors[:, k].imag]
    to = np.stack(columns, 1)
    pairs = np.array([(values[k].real, values[k].imag) for k in above]).reshape(-1, 2)
    return Spectrum(to, np.linalg.inv(to), values[real].real, pairs)


class MethodMatrix(NamedTuple):
    """Runge-Kutta matrix A (s, s) of an implicit method.

    Fields:
        a: A.
        inverse: the inverse of A.
        spectrum: the eigenvalues and eigenvectors of A as a `Spectrum`.
    """

    a: Any
    inverse: Any
    spectrum: Spectrum


def weights(a: np.ndarray, dtype: Any) -> MethodMatrix:
    """Compute the weights of a method with invertible A."""
    found = MethodMatrix(a, np.linalg.inv(a), spectrum(a))
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), found)


def weight(a: jax.Array) -> MethodMatrix:
    """Return the weights of a method of one stage, whose A is a scalar."""
    a = a.reshape(1, 1)
    one = jnp.ones_like(a)
    return MethodMatrix(a, 1 / a, Spectrum(one, one, a[0], jnp.zeros((0, 2), a.dtype)))


#: the inverse of a real matrix, or the real and imaginary part of the inverse of a complex one
Inverse = list[jax.Array]


class Sizes(NamedTuple):
    """Sizes of the system of equations.

    Fields:
        n: number of rates.
        kinematic: number of position rates, which come first. The velocity rates come next.
        depth: number of integrations from acceleration to each row.
        ggl: number of GGL rows, which come last and have multipliers mu.
    """

    n: int
    kinematic: int
    depth: tuple[int, ...]
    ggl: int

    @property
    def rows(self) -> int:
        """Number of rows with multipliers w."""
        return len(self.depth) - self.ggl


class GGLBlocks(NamedTuple):
    """Blocks of the GGL multipliers: inverse of M, Y = M^-1 G^T, G, inverse of S = G M^-1 G^T."""

    M: jax.Array
    Y: jax.Array
    G: jax.Array
    S: jax.Array


class Blocks(NamedTuple):
    """Inverted blocks of the simplified Newton matrix: K^-1 of the velocities and S^-1 of the rows
    for each eigenvalue, the gradient B of the rows, and the blocks of the GGL multipliers or None.
    """

    K: list[Inverse]
    S: list[Inverse]
    B: jax.Array
    ggl: GGLBlocks | None


class Simplified(NamedTuple):
    """Approximate inverse of the Newton matrix of all stages, one block per eigenvalue."""

    sizes: Sizes
    h: Any
    weights: MethodMatrix
    blocks: Blocks

    def solved(self, r: jax.Array) -> jax.Array:
        """Compute an approximate solution x (s, n + m) of the Newton equations of all stages."""
        n, k, depth, _ = self.sizes
        m = n + self.sizes.rows
        du, acting, rows, last = r[:, :k], r[:, k:n], r[:, n:m], r[:, m:]
        K, S, B, ggl = self.blocks
        if ggl:
            du = _times(ggl.M, du)
        if any(p > 1 for p in depth[: self.sizes.rows]):  # gradient of u times u' / z
            of_du = weighted_sums(self.weights.inverse / self.h, _times(B[:, :k], du))
            of_u = jnp.array([float(p > 1) for p in depth[: self.sizes.rows]], r.dtype)
            rows = rows - of_u * of_du
        to, back = self.weights.spectrum.to, self.weights.spectrum.back
        free = self._by_eigenvalue(K, weighted_sums(back, acting))
        w = self._by_eigenvalue(S, weighted_sums(back, rows) - _times(B, free))
        rates = free + self._by_eigenvalue(K, _times(B.T, w))
        rates, w = weighted_sums(to, rates), weighted_sums(to, w)
        du = du + self.h * weighted_sums(self.weights.a, rates[:, :k])
        if not ggl:
            return jnp.concatenate([du, rates, w], 1)
        mu = _times(ggl.S, last - _times(ggl.G, du))
        return jnp.concatenate([du + _times(ggl.Y, mu), rates, w, mu], 1)

    def free(self, r: jax.Array) -> jax.Array:
        """Compute approximate rates (s, n) of the Newton equations without constraint rows."""
        n, k, *_ = self.sizes
        du, acting = r[:, :k], r[:, k:n]
        if self.blocks.ggl:
            du = _times(self.blocks.ggl.M, du)
        to, back = self.weights.spectrum.to, self.weights.spectrum.back
        rates = weighted_sums(to, self._by_eigenvalue(self.blocks.K, weighted_sums(back, acting)))
        du = du + self.h * weighted_sums(self.weights.a, rates[:, :k])
        return jnp.concatenate([du, rates], 1)

    def _by_eigenvalue(self, blocks: list[Inverse], x: jax.Array) -> jax.Array:
        """Multiply each block by its rows of x: one for a real eigenvalue, two for a pair."""
        out, at = [], 0
        for block in blocks:
            if len(block) == 1:
                out.append(_times(block[0], x[at])[None])
            else:
                (re, im), p, q = block, x[at], x[at + 1]
                out.append(_times(re, x[at : at + 2]) + _times(im, jnp.stack([-q, p])))
            at += len(block)
        return jnp.concatenate(out)


def simplified(
    push: Callable[[jax.Array], jax.Array], sizes: Sizes, h: Any, weights: MethodMatrix,
    free_diagonal: jax.Array,
) -> Blocks:  # fmt: skip
    """Compute and invert the blocks of the simplified Newton matrix.

    Args:
        push: derivative of the equations (n + m,) along a change of (y, y', w) (2 n + m,) at the
            start of the step.
        sizes: sizes of the equations.
        h: step.
        weights: weights of the method.
        free_diagonal: (m,) diagonals of the Schur complements for free bodies; 0 if unknown.
    """
    n, k, depth, ggl = sizes
    dtype, m, rows = free_diagonal.dtype, len(depth), n + sizes.rows
    zs: list[tuple] = [(h * z,) for z in weights.spectrum.real]
    zs += [(h * z[0], h * z[1]) for z in weights.spectrum.pairs]
    of_u = jnp.array([p > 1 for p in depth[: sizes.rows]])

    def along(at: jax.Array, some: Any = True) -> jax.Array:
        return (jnp.arange(2 * n + m) == at).astype(dtype) * some

    def column(j: jax.Array) -> tuple:
        """Compute the columns of velocity or state number j: of K for each eigenvalue, of B, and of
        M and G for the GGL multipliers."""
        ways = jnp.stack([along(n + k + j), along(k + j), along(j, j < k)])
        M, D, K = each(push, ways)
        powers = [(*z, *_product(z, z)) for z in zs]
        blocks = []
        for z in powers:
            one, two = z[: len(z) // 2], z[len(z) // 2 :]
            parts = [d * D[k:n] + s * K[k:n] for d, s in zip(one, two, strict=True)]
            blocks.append([M[k:n] + parts[0], *parts[1:]])
        of_mu = (M[k : 2 * k], K[rows:]) if ggl else ()
        return blocks, jnp.where(of_u, K[n:rows], D[n:rows]), of_mu

    # the rows of these arrays are the columns of the blocks
    blocks, B, of_mu = each(column, jnp.arange(n - k))
    K = [[x.T for x in inverse(*block)] for block in blocks]
    own, others = free_diagonal[: sizes.rows], free_diagonal[sizes.rows :]
    S = [_regular([_times(B.T, _times(x, B.T)).T for x in one], own) for one in K]
    if not ggl:
        return Blocks(K, S, B.T, None)
    M, G = inverse(of_mu[0][:k])[0].T, of_mu[1][:k].T
    Y = _times(M, G).T
    return Blocks(K, S, B.T, GGLBlocks(M, Y, G, _regular([_times(G, Y.T).T], others)[0]))


def _product(x: tuple, y: tuple) -> tuple:
    """Multiply two numbers, real (x,) or complex (re, im)."""
    if len(x) == 1:
        return (x[0] * y[0],)
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _regular(S: Inverse, free_diagonal: jax.Array) -> Inverse:
    """Return the inverse of S + E, with E the regularization."""
    eps, vanishing, _ = regularization(free_diagonal.dtype)
    size = jnp.abs(jnp.diagonal(S[0]))
    E = eps * size + diagonal_floor(size, free_diagonal, vanishing)
    E = jnp.where(E > 0, E, 1.0) * jnp.eye(len(size), dtype=size.dtype)
    return inverse(S[0] + E, *S[1:])


def _times(A: jax.Array, x: jax.Array) -> jax.Array:
    """Compute x A^T: the product of A and each row of x, in full precision."""
    return jnp.matmul(x, A.T, precision=jax.lax.Precision.HIGHEST)
