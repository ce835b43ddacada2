"""The matrix of simplified Newton iterations of constrained motion, inverted block by block.

    equations  kinematic  E (u' - v) - F mu = 0                 unknowns  u'
               dynamic    f(u, v, x, v', x') - C w = 0                    v', x'
               rows       one of u or v, held by w                        w
               again      rows of u, held by mu (GGL), if any             mu
All stages share one matrix, that of the start of the step. With the eigenvalues z / h of the
method's matrix (`spectrum`) it comes apart into one for each, of the size of one stage. From
these u' = (v' z + ...) is eliminated:

    K(z) = M + z D + z^2 K       of v', x': masses, dampings, stiffnesses
    S(z) = B K(z)^-1 C           of w: B are the rows' gradients, which appear with z^-p z^p = 1
    S_mu = G E^-1 F              of mu, after v' and w; no z is in it
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
from rbjax.lanes.each import each
from rbjax.lanes.proximal import damped, least
from rbjax.solvers.spectrum import Weights
from rbjax.solvers.steps import mixed

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
    """Of mu: the inverse of E; E^-1 F; G; the inverse of S_mu."""

    E: jax.Array
    Y: jax.Array
    G: jax.Array
    S: jax.Array


class Simplified(NamedTuple):
    """The inverted blocks: of each eigenvalue, K^-1 and S^-1; B, C, and what belongs to mu."""

    sizes: Sizes
    h: Any
    weights: Weights
    K: list[Inverse]
    S: list[Inverse]
    B: jax.Array
    C: jax.Array
    again: Again | None

    def solved(self, r: jax.Array) -> jax.Array:
        """x (s, n + m) of matrix x = r, nearly."""
        n, k, depth, _ = self.sizes
        m = n + self.sizes.rows
        du, acting, rows, last = r[:, :k], r[:, k:n], r[:, n:m], r[:, m:]
        if self.again:
            du = _times(self.again.E, du)
        twice = [i for i, p in enumerate(depth[: self.sizes.rows]) if p > 1]
        if twice:  # the gradient of a row of u, times u' / z
            of_du = mixed(self.weights.inverse / self.h, _times(self.B[:, :k], du))
            of_u = jnp.array([float(p > 1) for p in depth[: self.sizes.rows]], r.dtype)
            rows = rows - of_u * of_du
        to, back = self.weights.spectrum.to, self.weights.spectrum.back
        free = self._by_eigenvalue(self.K, mixed(back, acting))
        w = self._by_eigenvalue(self.S, mixed(back, rows) - _times(self.B, free))
        rates = free + self._by_eigenvalue(self.K, _times(self.C, w))
        rates, w = mixed(to, rates), mixed(to, w)
        du = du + self.h * mixed(self.weights.a, rates[:, :k])
        if not self.again:
            return jnp.concatenate([du, rates, w], 1)
        mu = _times(self.again.S, last - _times(self.again.G, du))
        return jnp.concatenate([du + _times(self.again.Y, mu), rates, w, mu], 1)

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
) -> Simplified:  # fmt: skip
    """push: from changes of (y, y', w) (2 n + m,) at the start to that of the equations (n + m,);
    usual (m,): the diagonals of S and S_mu where no row vanishes, 0 where that is not known."""
    n, k, depth, again = sizes
    dtype, m, rows = usual.dtype, len(depth), n + sizes.rows
    zs: list[tuple] = [(h * z,) for z in weights.spectrum.real]
    zs += [(h * z[0], h * z[1]) for z in weights.spectrum.pairs]
    of_u = jnp.array([p > 1 for p in depth[: sizes.rows]])

    def along(at: jax.Array, some: Any = True) -> jax.Array:
        return (jnp.arange(2 * n + m) == at).astype(dtype) * some

    push = jax.jit(push)

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
        return blocks, jnp.where(of_u, K[n:rows], D[n:rows]), K[rows:]

    def effect(of: int, rows: slice) -> Callable[[jax.Array], jax.Array]:
        return lambda j: push(along(of + j))[rows]

    # the columns of the blocks are the rows of these arrays
    blocks, B, G = each(column, jnp.arange(n - k))
    C = -each(effect(2 * n, slice(k, n)), jnp.arange(sizes.rows)).T
    K = [[x.T for x in inverse(*block)] for block in blocks]
    own, others = usual[: sizes.rows], usual[sizes.rows :]
    S = [_regular([_times(B.T, _times(x, C.T)).T for x in one], own) for one in K]
    found = Simplified(sizes, h, weights, K, S, B.T, C, None)
    if not again:
        return found
    E = inverse(each(effect(n, slice(k)), jnp.arange(k)))[0].T
    F = -each(effect(2 * n + sizes.rows, slice(k)), jnp.arange(again))
    Y, G = _times(E, F).T, G[:k].T
    return found._replace(again=Again(E, Y, G, _regular([_times(G, Y.T).T], others)[0]))


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
