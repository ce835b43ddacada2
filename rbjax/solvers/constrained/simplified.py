"""The matrix of simplified Newton iterations of constrained motion, inverted block by block.

    equations  kinematic  u' - v = 0                            unknowns  u'
                or, GGL   M (u' - v) - G^T mu = 0
               dynamic    f(u, v, x, v', x') - B^T w = 0                  v', x'
               rows       one of u or v, with gradients B, held by w      w
               again      rows of u, with gradients G, held by mu (GGL)   mu
Multipliers act along the gradients of their rows, as d'Alembert says. All stages share one matrix,
that of the start of the step. With the eigenvalues z / h of the method's matrix (`spectrum`) it
comes apart into one for each, of the size of one stage. From these u' = (v' z + ...) is eliminated:

    K(z) = M + z D + z^2 K       of v', x': masses, dampings, stiffnesses
    S(z) = B K(z)^-1 B^T         of w: gradients of rows appear with z^-p z^p = 1
    S_mu = G M^-1 G^T            of mu, after v' and w; no z is in it
Left out is what is smaller by h times a rate of the motion: the matrix of the start leaves out as
much. The products of gradients with velocities, attitudes that turn, and what mu does to v'.
Where S is singular, E is added to it as in `stage_matrix`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import inverse
from rbjax.lanes.arrays import each
from rbjax.lanes.factorization import damped, least
from rbjax.solvers.common.steps import mixed
from rbjax.solvers.constrained.spectrum import Weights

#: the inverse of a real matrix, or the parts of that of a complex one
Inverse = list[jax.Array]


class Sizes(NamedTuple):
    """Of n rates the first `kinematic` are increments of positions, whose own rates come next; of
    the rows (depth: the integrations of each) the last `again` hold positions by mu."""

    n: int
    kinematic: int
    depth: tuple[int, ...]
    again: int

    @property
    def rows(self) -> int:
        """Those that are held by w."""
        return len(self.depth) - self.again


class Again(NamedTuple):
    """Of mu: the inverse of M; M^-1 G^T; G; the inverse of S_mu."""

    M: jax.Array
    Y: jax.Array
    G: jax.Array
    S: jax.Array


class Blocks(NamedTuple):
    """The inverted blocks: of each eigenvalue, K^-1 and S^-1; B, and what belongs to mu."""

    K: list[Inverse]
    S: list[Inverse]
    B: jax.Array
    again: Again | None


class Simplified(NamedTuple):
    """Solves with the inverted blocks."""

    sizes: Sizes
    h: Any
    weights: Weights
    blocks: Blocks

    def solved(self, r: jax.Array) -> jax.Array:
        """x (s, n + m) of matrix x = r, nearly."""
        n, k, depth, _ = self.sizes
        m = n + self.sizes.rows
        du, acting, rows, last = r[:, :k], r[:, k:n], r[:, n:m], r[:, m:]
        K, S, B, again = self.blocks
        if again:
            du = _times(again.M, du)
        twice = [i for i, p in enumerate(depth[: self.sizes.rows]) if p > 1]
        if twice:  # the gradient of a row of u, times u' / z
            of_du = mixed(self.weights.inverse / self.h, _times(B[:, :k], du))
            of_u = jnp.array([float(p > 1) for p in depth[: self.sizes.rows]], r.dtype)
            rows = rows - of_u * of_du
        to, back = self.weights.spectrum.to, self.weights.spectrum.back
        free = self._by_eigenvalue(K, mixed(back, acting))
        w = self._by_eigenvalue(S, mixed(back, rows) - _times(B, free))
        rates = free + self._by_eigenvalue(K, _times(B.T, w))
        rates, w = mixed(to, rates), mixed(to, w)
        du = du + self.h * mixed(self.weights.a, rates[:, :k])
        if not again:
            return jnp.concatenate([du, rates, w], 1)
        mu = _times(again.S, last - _times(again.G, du))
        return jnp.concatenate([du + _times(again.Y, mu), rates, w, mu], 1)

    def free(self, r: jax.Array) -> jax.Array:
        """Rates (s, n) of the equations without rows, with rest r (s, n), nearly."""
        n, k, *_ = self.sizes
        du, acting = r[:, :k], r[:, k:n]
        if self.blocks.again:
            du = _times(self.blocks.again.M, du)
        to, back = self.weights.spectrum.to, self.weights.spectrum.back
        rates = mixed(to, self._by_eigenvalue(self.blocks.K, mixed(back, acting)))
        return jnp.concatenate([du + self.h * mixed(self.weights.a, rates[:, :k]), rates], 1)

    def _by_eigenvalue(self, blocks: list[Inverse], x: jax.Array) -> jax.Array:
        """Each block times its rows of x: one of a real eigenvalue, two of a complex one."""
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
    push: Callable[[jax.Array], jax.Array], sizes: Sizes, h: Any, weights: Weights,
    usual: jax.Array,
) -> Blocks:  # fmt: skip
    """push: from changes of (y, y', w) (2 n + m,) at the start to that of the equations (n + m,);
    usual (m,): the diagonals of S and S_mu where no row vanishes, 0 where that is not known."""
    n, k, depth, again = sizes
    dtype, m, rows = usual.dtype, len(depth), n + sizes.rows
    zs: list[tuple] = [(h * z,) for z in weights.spectrum.real]
    zs += [(h * z[0], h * z[1]) for z in weights.spectrum.pairs]
    of_u = jnp.array([p > 1 for p in depth[: sizes.rows]])

    def along(at: jax.Array, some: Any = True) -> jax.Array:
        return (jnp.arange(2 * n + m) == at).astype(dtype) * some

    def column(j: jax.Array) -> tuple:
        """Of all blocks, that of a velocity or of a state x."""
        ways = jnp.stack([along(n + k + j), along(k + j), along(j, j < k)])
        M, D, K = each(push, ways)
        powers = [(*z, *_product(z, z)) for z in zs]
        blocks = []
        for z in powers:
            one, two = z[: len(z) // 2], z[len(z) // 2 :]
            parts = [d * D[k:n] + s * K[k:n] for d, s in zip(one, two, strict=True)]
            blocks.append([M[k:n] + parts[0], *parts[1:]])
        of_mu = (M[k : 2 * k], K[rows:]) if again else ()
        return blocks, jnp.where(of_u, K[n:rows], D[n:rows]), of_mu

    # the columns of the blocks are the rows of these arrays
    blocks, B, of_mu = each(column, jnp.arange(n - k))
    K = [[x.T for x in inverse(*block)] for block in blocks]
    own, others = usual[: sizes.rows], usual[sizes.rows :]
    S = [_regular([_times(B.T, _times(x, B.T)).T for x in one], own) for one in K]
    if not again:
        return Blocks(K, S, B.T, None)
    M, G = inverse(of_mu[0][:k])[0].T, of_mu[1][:k].T
    Y = _times(M, G).T
    return Blocks(K, S, B.T, Again(M, Y, G, _regular([_times(G, Y.T).T], others)[0]))


def _product(x: tuple, y: tuple) -> tuple:
    """Of two numbers, real or complex."""
    if len(x) == 1:
        return (x[0] * y[0],)
    return x[0] * y[0] - x[1] * y[1], x[0] * y[1] + x[1] * y[0]


def _regular(S: Inverse, usual: jax.Array) -> Inverse:
    """The inverse of S + E."""
    eps, vanishing, _ = damped(usual.dtype)
    size = jnp.abs(jnp.diagonal(S[0]))
    E = eps * size + least(size, usual, vanishing)
    E = jnp.where(E > 0, E, 1.0) * jnp.eye(len(size), dtype=size.dtype)
    return inverse(S[0] + E, *S[1:])


def _times(A: jax.Array, x: jax.Array) -> jax.Array:
    """A x of each row of x."""
    return jnp.matmul(x, A.T, precision=jax.lax.Precision.HIGHEST)
