"""Constrained motion as one linear problem of arrays, for the formulations of the textbooks:

    [M  -G^T] [a]   [f]        f = tau + sum of J_i^T f_i - b,   c: what the rows ask
    [G    0 ] [l] = [c]
M by CRBA, b by RNEA, G row by row. A formulation is one way to the same (a, l). Its derivative is
that of the problem and not of the way (`jax.lax.custom_linear_solve`): finite where singular values
coincide, to all orders.

Ranks are decided where coordinates and rows have been scaled: diag(M) = 1, rows of length one but
for those that are zero beside the others. What then is below the root of the rounding unit is zero.

Singular positions. A row that vanishes with the arms of its forces stays short, against what it is
of free bodies (`as_free_bodies`): below 1e-5 of that in f64. In f32 all rows are measured by it,
and what is below 1e-2 is zero (`system` says why): with a `Projection` after steps, ten
seconds of a parallelogram keep their energy to 2e-3 J of 20. With rows of length one, and the root
of the rounding unit, they were lost. By itself none of these formulations passes many such
positions: rows drift, and the other branch is then as near.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.constrained_motion import (
    Solve,
    System,
    as_free_bodies,
    constrained_motion,
)
from rbjax.constraints.equations.model_rows import gradient_matrix
from rbjax.constraints.methods.method import Method
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.crba import crba
from rbjax.dynamics.algorithms.rnea import LinkForces, rnea
from rbjax.dynamics.drivers.choice import Driver
from rbjax.forces.context import Context
from rbjax.lanes import Lane
from rbjax.lanes.arrays import matmat, matvec, pack
from rbjax.lanes.factorization import diagonal_floor
from rbjax.rank_tolerances import rank_tolerance

#: a (nv,) and l (rows,)
Solution = tuple[jax.Array, jax.Array]


@dataclass(frozen=True)
class Dense(Method):
    """A method on arrays. Its `solution` is the equation of a textbook."""

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        """a and l of M a = f + G^T l, G a = c, linear in f and c; G may have redundant rows."""
        raise NotImplementedError(f"{type(self).__name__} has no method solution(M, G, f, c)")

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        return constrained_motion(model, t, state, tau, f_ext, alpha, beta, method=self._method)[0]

    def _method(
        self, d: Driver, now: Context, tau: jax.Array, f_ext: LinkForces
    ) -> tuple[None, jax.Array, System]:
        joints, gravity = now.links.joints, d.prepared.gravity
        M = crba(d, joints, tau)
        force = tau - d.pack(rnea(d, joints, d.lanes(None), gravity, f_ext), tau)

        def system(now: Context, rows: Sequence[Row]) -> Solve:
            G = gradient_matrix(now, rows)
            usual = pack([as_free_bodies(d, row) for row in rows], tau)

            def solve(force: jax.Array | None, c: Sequence[Lane]) -> Solution:
                f = jnp.zeros_like(tau) if force is None else force
                return self.solved(M, G, f, pack(c, f), usual)

            return solve

        return None, force, system

    def solved(
        self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array, usual: Any = 0.0
    ) -> Solution:
        """`solution` of the scaled problem, scaled back, with the derivative of the equations.
        usual (rows,): diag(G M^-1 G^T) where no row vanishes; 0 where that is not known."""
        usual = jax.lax.stop_gradient(jnp.asarray(usual, G.dtype))

        def equations(x: Solution) -> Solution:
            a, l = x
            return matvec(M, a) - matvec(G.T, l), matvec(G, a)

        def way(_: Any, b: Solution) -> Solution:
            return self._scaled(M, G, *b, usual)

        def way_transposed(_: Any, b: Solution) -> Solution:
            a, l = self._scaled(M, G, b[0], -b[1], usual)
            return a, -l

        return jax.lax.custom_linear_solve(equations, (f, c), way, way_transposed)

    def _scaled(
        self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array, usual: jax.Array
    ) -> Solution:
        s = 1.0 / jnp.sqrt(jnp.diagonal(M))
        G = G * s
        squares = (G * G).sum(1)
        root = float(np.sqrt(jnp.finfo(G.dtype).eps))
        squares = squares + diagonal_floor(
            squares, usual, rank_tolerance("short row", G.dtype), root
        )
        r = 1.0 / jnp.sqrt(jnp.where(squares > 0, squares, 1.0))
        a, l = self.solution(s[:, None] * M * s, r[:, None] * G, s * f, r * c)
        return s * a, r * l


def inverted(x: jax.Array, power: int = 1) -> jax.Array:
    """Invert x, except elements that are zero relative to the largest one: below the tolerance of
    constraint rows to a power. Their inverse is 0."""
    size = jnp.abs(x)
    held = size > rank_tolerance("constraint rows", x.dtype) ** power * size.max()
    return jnp.where(held, 1.0 / jnp.where(held, x, 1.0), 0.0)


def pseudo_inverse(A: jax.Array) -> jax.Array:
    """A^+ (n, m), by the singular values of A (m, n)."""
    U, s, Vt = jnp.linalg.svd(A, full_matrices=False)
    return matmat(Vt.T * inverted(s), U.T)


def solve_positive(A: jax.Array, b: jax.Array) -> jax.Array:
    """x of A x = b, A symmetric and positive definite."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(A), b)


@dataclass(frozen=True)
class KKT(Dense):
    """Index 1, accelerations and multipliers at once:

        [M  -G^T] [a]   [f]
        [G    0 ] [l] = [c]
    as a symmetric system (of a and -l) by its eigenvalues. Where rows are redundant it is singular,
    and l is the solution of least norm.

    Source: Haug, *Computer-Aided Kinematics and Dynamics*, 11.3; Masarati, ch. 8.
    """

    name: ClassVar[str] = "kkt"
    family: ClassVar[str] = "redundant"
    index: ClassVar[int] = 1

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        n, m = len(f), len(c)
        K = jnp.block([[M, G.T], [G, jnp.zeros((m, m), M.dtype)]])
        w, V = jnp.linalg.eigh(K)
        x = matvec(V, inverted(w, 2) * matvec(V.T, jnp.concatenate([f, c])))
        return x[:n], -x[n:]


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
        zero = rank_tolerance("constraint rows", G.dtype) * jnp.abs(G).max()

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


@dataclass(frozen=True)
class UdwadiaKalaba(Dense):
    """Index 0, by Gauss's principle: of the accelerations that the rows allow the one nearest to
    free motion a_f = M^-1 f, in the norm of M:

        a = a_f + M^-1/2 (G M^-1/2)^+ (c - G a_f)

    Source: Udwadia & Kalaba 1992; Masarati, ch. 8.
    """

    name: ClassVar[str] = "udwadia_kalaba"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        w, V = jnp.linalg.eigh(M)
        root = matmat(V / jnp.sqrt(w), V.T)
        free = matvec(root, matvec(root, f))
        inverse = pseudo_inverse(matmat(G, root))
        y = matvec(inverse, c - matvec(G, free))
        return free + matvec(root, y), matvec(inverse.T, y)


@dataclass(frozen=True)
class ForceProjection(Dense):
    """Index 0, by forces without their part along the rows. P = 1 - G^+ G takes it out, G^T l too:

        (P M P + 1 - P) w = P (f - M G^+ c),     a = G^+ c + P w
    An (nv, nv) system, with no basis of the null space. (diag(M) is about 1 where it is solved.)

    Source: Arabyan & Wu 1998; Masarati, ch. 8.
    """

    name: ClassVar[str] = "force_projection"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        inverse = pseudo_inverse(G)
        kept = jnp.eye(len(f), dtype=M.dtype)
        P = kept - matmat(inverse, G)
        a = matvec(inverse, c)
        H = matmat(P, matmat(M, P)) + kept - P
        a = a + matvec(P, solve_positive(H, matvec(P, f - matvec(M, a))))
        return a, matvec(inverse.T, matvec(M, a) - f)


@dataclass(frozen=True)
class AugmentedLagrangian(Dense):
    """Index 0, by penalties on accelerations that an iteration takes back, from a_0 = M^-1 f:

        (M + alpha G^T G) a_{i+1} = M a_i + alpha G^T c
        G a_{i+1} - c = (1 + alpha G M^-1 G^T)^-1 (G a_i - c),     l = sum of alpha (c - G a_i)
    No rank is decided: redundant rows only add to the penalty. M a = f + G^T l holds after each
    iteration. The derivative is that of the limit, by as many iterations: what these leave is
    missing from it too.

    Fields: alpha, where coordinates and rows are scaled so that diag(M) = 1 and rows have length
    one; iterations.

    Source: Bayo, Garcia de Jalon & Serna 1988; Masarati, ch. 8.
    """

    alpha: float = 1e3
    iterations: int = 10
    name: ClassVar[str] = "augmented_lagrangian"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        factors = jax.scipy.linalg.cho_factor(M + self.alpha * matmat(G.T, G))
        a, l = solve_positive(M, f), jnp.zeros_like(c)
        for _ in range(self.iterations):
            asked = l + self.alpha * (c - matvec(G, a))
            off = f - matvec(M, a) + matvec(G.T, asked)  # f - M a + G^T l is zero but for rounding
            a = a + jax.scipy.linalg.cho_solve(factors, off)
            l = l + self.alpha * (c - matvec(G, a))
        return a, l
