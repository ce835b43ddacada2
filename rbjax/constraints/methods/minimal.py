"""Formulations in the coordinates that are left: the minimal family.

    a = L c + Z z,     (Z^T M Z) z = Z^T (f - M L c),     l = L^T (M a - f)
L is a generalized inverse of G (G L G = G), so L c is one acceleration that the rows allow, and the
columns of Z span all that they leave free (G Z = 0). No multiplier is solved for. The methods
differ in L and Z. (Masarati, *Multibody System Dynamics*, ch. 8)

Z is (nv, nv), with a zero column for each coordinate that is not free: its rank belongs to the
state, and not to the program.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from rbjax.constraints.methods.dense import NEGLIGIBLE, Dense, Solution, inverted, solve_positive
from rbjax.lanes.arrays import matmat, matvec


@dataclass(frozen=True)
class Minimal(Dense):
    """A formulation by L and Z. Its method is `split`."""

    family: ClassVar[str] = "minimal"
    index: ClassVar[int] = 0

    def split(self, G: jax.Array) -> tuple[jax.Array, jax.Array]:
        """L (nv, rows) and Z (nv, nv)."""
        raise NotImplementedError(f"{type(self).__name__} has no method split(G) -> L, Z")

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        L, Z = self.split(G)
        a = matvec(L, c)
        gone = (Z == 0).all(0)
        H = matmat(Z.T, matmat(M, Z)) + jnp.where(gone, jnp.eye(len(f), dtype=M.dtype), 0.0)
        a = a + matvec(Z, solve_positive(H, matvec(Z.T, f - matvec(M, a))))
        return a, matvec(L.T, matvec(M, a) - f)


@dataclass(frozen=True)
class NullSpaceSVD(Minimal):
    """Index 0, in an orthonormal basis of the null space from singular values:

        G = U S V^T,   L = V S^+ U^T = G^+,   Z = the columns of V at the zeros of S

    Source: Mani, Haug & Atkinson 1985; Masarati, ch. 8.
    """

    name: ClassVar[str] = "null_space_svd"

    def split(self, G: jax.Array) -> tuple[jax.Array, jax.Array]:
        U, s, Vt = jnp.linalg.svd(G, full_matrices=True)
        k = len(s)
        inverse = inverted(s)
        free = jnp.concatenate([inverse == 0, jnp.ones(len(Vt) - k, bool)])
        return matmat(Vt[:k].T * inverse, U[:, :k].T), Vt.T * free


@dataclass(frozen=True)
class NullSpaceQR(Minimal):
    """Index 0, in an orthonormal basis of the null space from a QR factorization with pivots:

        G^T P = [Q_1 Z] [R_1 R_2; 0 0],   L = Q_1 R_1^-T P_1^T
    R_1 ends where the diagonal of R falls to zero: the rows beyond P_1 are redundant, and their
    multipliers are zero.

    Source: Kim & Vanderploeg 1986; Masarati, ch. 8.
    """

    name: ClassVar[str] = "null_space_qr"

    def split(self, G: jax.Array) -> tuple[jax.Array, jax.Array]:
        Q, R, pivots = jax.lax.linalg.qr(G.T, pivoting=True)
        k = min(G.shape)
        held = inverted(jnp.diagonal(R)) != 0
        eye = jnp.eye(k, dtype=G.dtype)
        R_1 = jnp.where(held[:, None] & held, R[:k, :k], eye)
        inverse = jax.scipy.linalg.solve_triangular(R_1, eye, trans=1)
        L = jnp.zeros_like(G.T).at[:, pivots[:k]].set(matmat(Q[:, :k] * held, inverse * held))
        return L, Q * jnp.concatenate([~held, jnp.ones(len(Q) - k, bool)])


@dataclass(frozen=True)
class Partitioning(Minimal):
    """Index 0, in some of the velocities themselves, the independent ones v_i:

        G_d a_d = c - G_i a_i,   Z = [-G_d^-1 G_i; 1],   L = [G_d^-1; 0]
    Elimination with full pivoting chooses the dependent ones at each state, and of redundant rows
    those that count; the multipliers of the others are zero.

    Source: Wehage & Haug 1982; Masarati, ch. 8.
    """

    name: ClassVar[str] = "partitioning"

    def split(self, G: jax.Array) -> tuple[jax.Array, jax.Array]:
        m, n = G.shape
        zero = NEGLIGIBLE[G.dtype.itemsize] * jnp.abs(G).max()

        def eliminate(_: int, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
            W, chosen = x  # G and 1, reduced so far (Gauss-Jordan); the pivots
            left = ~chosen.any(1)[:, None] & ~chosen.any(0)
            size = jnp.where(left, jnp.abs(W[:, :n]), -1.0)
            i, j = jnp.unravel_index(size.argmax(), (m, n))
            row = W[i] / jnp.where(size[i, j] > zero, W[i, j], 1.0)
            reduced = (W - W[:, j][:, None] * row).at[i].set(row)
            found = size[i, j] > zero
            return jnp.where(found, reduced, W), chosen.at[i, j].set(found | chosen[i, j])

        start = jnp.concatenate([G, jnp.eye(m, dtype=G.dtype)], 1), jnp.zeros((m, n), bool)
        W, chosen = jax.lax.fori_loop(0, min(m, n), eliminate, start)
        to_coordinates = chosen.T.astype(G.dtype)
        Z = jnp.eye(n, dtype=G.dtype) - matmat(to_coordinates, W[:, :n])
        return matmat(to_coordinates, W[:, n:]), jnp.where(chosen.any(0), 0.0, Z)
