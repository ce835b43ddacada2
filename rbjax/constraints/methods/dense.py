"""Dense methods: the textbook formulations of constrained motion, on arrays.

    [M  -G^T] [a]   [f]        f = tau + sum of J_i^T f_i - b,   c: right-hand side of the rows
    [G    0 ] [l] = [c]
M comes from CRBA and b from RNEA. Derivatives are those of these equations, so they stay finite if
singular values coincide. Coordinates are scaled to diag(M) = 1 and rows to length one, except rows
that are short compared with the rows of free bodies, as at singular positions. Singular values
below a tolerance count as zero (`rbjax.rank_tolerances`).

Minimal methods compute a matrix L with G L G = G, and Z, whose columns span the null space of G:

    a = L c + Z z,     (Z^T M Z) z = Z^T (f - M L c),     l = L^T (M a - f)
Z is (nv, nv), with zero columns for dependent coordinates, because the rank is unknown at compile
time.

Source: Masarati, *Multibody System Dynamics*, 7.1, 8.3, 9.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.constrained_motion import (
    LinearProblem,
    Solve,
    constrained_motion,
    free_body_diagonal,
)
from rbjax.constraints.equations.model_rows import gradient_matrix
from rbjax.constraints.equations.projection import eliminate
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
    """Base class of dense methods. Subclasses implement `solution`."""

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        """Solve M a = f + G^T l, G a = c for a and l. G may have redundant rows."""
        raise NotImplementedError(f"{type(self).__name__} has no method solution(M, G, f, c)")

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        return constrained_motion(model, t, state, tau, f_ext, alpha, beta, method=self._method)[0]

    def _method(
        self, d: Driver, context: Context, tau: jax.Array, f_ext: LinkForces
    ) -> LinearProblem:
        joints, gravity = context.links.joints, d.prepared.gravity
        M = crba(d, joints, tau)
        force = tau - d.pack(rnea(d, joints, d.lanes(None), gravity, f_ext), tau)

        def factor(context: Context, rows: Sequence[Row]) -> Solve:
            G = gradient_matrix(context, rows)
            free_diagonal = pack([free_body_diagonal(d, row) for row in rows], tau)

            def solve(force: jax.Array | None, c: Sequence[Lane]) -> Solution:
                f = jnp.zeros_like(tau) if force is None else force
                return self.scaled_solution(M, G, f, pack(c, f), free_diagonal)

            return solve

        return LinearProblem(None, force, factor)

    def scaled_solution(
        self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array, free_diagonal: Any = 0.0
    ) -> Solution:
        """Solve the equations after scaling, with the derivative of the equations. `free_diagonal`
        (rows,) is the diagonal of G M^-1 G^T for free bodies (`free_body_diagonal`), or 0 if
        unknown."""
        free_diagonal = jax.lax.stop_gradient(jnp.asarray(free_diagonal, G.dtype))

        def equations(x: Solution) -> Solution:
            a, l = x
            return matvec(M, a) - matvec(G.T, l), matvec(G, a)

        def solve(_: Any, b: Solution) -> Solution:
            return self._scaled(M, G, *b, free_diagonal)

        def solve_transposed(_: Any, b: Solution) -> Solution:
            a, l = self._scaled(M, G, b[0], -b[1], free_diagonal)
            return a, -l

        return jax.lax.custom_linear_solve(equations, (f, c), solve, solve_transposed)

    def _scaled(
        self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array, free_diagonal: jax.Array
    ) -> Solution:
        s = 1.0 / jnp.sqrt(jnp.diagonal(M))
        G = G * s
        squares = (G * G).sum(1)
        root = float(np.sqrt(jnp.finfo(G.dtype).eps))
        squares = squares + diagonal_floor(
            squares, free_diagonal, rank_tolerance("short row", G.dtype), root
        )
        r = 1.0 / jnp.sqrt(jnp.where(squares > 0, squares, 1.0))
        a, l = self.solution(s[:, None] * M * s, r[:, None] * G, s * f, r * c)
        return s * a, r * l


def invert_nonzero(x: jax.Array, power: int = 1) -> jax.Array:
    """Return 1 / x elementwise, and 0 for elements that are zero relative to the largest one. The
    relative tolerance is the rank tolerance "constraint rows" to the given power."""
    size = jnp.abs(x)
    nonzero = size > rank_tolerance("constraint rows", x.dtype) ** power * size.max()
    return jnp.where(nonzero, 1.0 / jnp.where(nonzero, x, 1.0), 0.0)


def pseudo_inverse(A: jax.Array) -> jax.Array:
    """Return the pseudo-inverse A^+ (n, m) of A (m, n), by singular values."""
    U, s, Vt = jnp.linalg.svd(A, full_matrices=False)
    return matmat(Vt.T * invert_nonzero(s), U.T)


def solve_positive(A: jax.Array, b: jax.Array) -> jax.Array:
    """Solve A x = b with A symmetric and positive definite."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(A), b)


@dataclass(frozen=True)
class KKT(Dense):
    """Index 1, with accelerations and multipliers in one linear system:

        [M  -G^T] [a]   [f]
        [G    0 ] [l] = [c]
    solved by an eigendecomposition of the symmetric matrix for (a, -l). If rows are redundant, l is
    the solution of least norm.

    Source: Haug, *Computer-Aided Kinematics and Dynamics*, 11.3; Masarati 8.3.
    """

    name: ClassVar[str] = "kkt"
    family: ClassVar[str] = "redundant"
    index: ClassVar[int] = 1

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        n, m = len(f), len(c)
        K = jnp.block([[M, G.T], [G, jnp.zeros((m, m), M.dtype)]])
        w, V = jnp.linalg.eigh(K)
        x = matvec(V, invert_nonzero(w, 2) * matvec(V.T, jnp.concatenate([f, c])))
        return x[:n], -x[n:]


@dataclass(frozen=True)
class Minimal(Dense):
    """Base class of null-space methods. Subclasses implement `split`."""

    family: ClassVar[str] = "minimal"
    index: ClassVar[int] = 0

    def split(self, G: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return L (nv, rows) with G L G = G, and Z (nv, nv) that spans the null space of G."""
        raise NotImplementedError(f"{type(self).__name__} has no method split(G) -> L, Z")

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        L, Z = self.split(G)
        a = matvec(L, c)
        dependent = (Z == 0).all(0)
        H = matmat(Z.T, matmat(M, Z)) + jnp.where(dependent, jnp.eye(len(f), dtype=M.dtype), 0.0)
        a = a + matvec(Z, solve_positive(H, matvec(Z.T, f - matvec(M, a))))
        return a, matvec(L.T, matvec(M, a) - f)


@dataclass(frozen=True)
class NullSpaceSVD(Minimal):
    """A method of index 0 in an orthonormal basis of the null space, by singular values:

        G = U S V^T,   L = V S^+ U^T = G^+,   Z = columns of V whose singular value is zero

    Source: Mani, Haug & Atkinson 1985; Masarati 7.1.
    """

    name: ClassVar[str] = "null_space_svd"

    def split(self, G: jax.Array) -> tuple[jax.Array, jax.Array]:
        U, s, Vt = jnp.linalg.svd(G, full_matrices=True)
        k = len(s)
        inverse = invert_nonzero(s)
        free = jnp.concatenate([inverse == 0, jnp.ones(len(Vt) - k, bool)])
        return matmat(Vt[:k].T * inverse, U[:, :k].T), Vt.T * free


@dataclass(frozen=True)
class NullSpaceQR(Minimal):
    """Index 0, in an orthonormal basis of the null space by a pivoted QR factorization:

        G^T P = [Q_1 Z] [R_1 R_2; 0 0],   L = Q_1 R_1^-T P_1^T
    Rows that P_1 does not select are redundant. Their multipliers are zero.

    Source: Kim & Vanderploeg 1986; Masarati 7.1.
    """

    name: ClassVar[str] = "null_space_qr"

    def split(self, G: jax.Array) -> tuple[jax.Array, jax.Array]:
        Q, R, pivots = jax.lax.linalg.qr(G.T, pivoting=True)
        k = min(G.shape)
        kept = invert_nonzero(jnp.diagonal(R)) != 0
        eye = jnp.eye(k, dtype=G.dtype)
        R_1 = jnp.where(kept[:, None] & kept, R[:k, :k], eye)
        inverse = jax.scipy.linalg.solve_triangular(R_1, eye, trans=1)
        L = jnp.zeros_like(G.T).at[:, pivots[:k]].set(matmat(Q[:, :k] * kept, inverse * kept))
        return L, Q * jnp.concatenate([~kept, jnp.ones(len(Q) - k, bool)])


@dataclass(frozen=True)
class Partitioning(Minimal):
    """Index 0, in the accelerations of independent coordinates a_i:

        G_d a_d = c - G_i a_i,   Z = [-G_d^-1 G_i; 1],   L = [G_d^-1; 0]
    At each state, elimination with full pivoting chooses the dependent coordinates and the
    independent rows. Multipliers of redundant rows are zero. Combine it with
    `IndependentCoordinates` to integrate only the independent coordinates.

    Source: Wehage & Haug 1982; Masarati 7.1.1.
    """

    name: ClassVar[str] = "partitioning"

    def split(self, G: jax.Array) -> tuple[jax.Array, jax.Array]:
        n = G.shape[1]
        W, chosen = eliminate(G)
        to_coordinates = chosen.T.astype(G.dtype)
        Z = jnp.eye(n, dtype=G.dtype) - matmat(to_coordinates, W[:, :n])
        return matmat(to_coordinates, W[:, n:]), jnp.where(chosen.any(0), 0.0, Z)


@dataclass(frozen=True)
class UdwadiaKalaba(Dense):
    """Index 0, by Gauss's principle of least constraint:

        a = a_f + M^-1/2 (G M^-1/2)^+ (c - G a_f)
    a satisfies the rows and is nearest to the free acceleration a_f = M^-1 f in the norm of M.

    Source: Udwadia & Kalaba 1992; Masarati 9.1.
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
    """Index 0, by projection of the forces with P = 1 - G^+ G, which removes G^T l:

        (P M P + 1 - P) w = P (f - M G^+ c),     a = G^+ c + P w

    Source: Arabyan & Wu 1998; Masarati 9.3.
    """

    name: ClassVar[str] = "force_projection"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0

    def solution(self, M: jax.Array, G: jax.Array, f: jax.Array, c: jax.Array) -> Solution:
        inverse = pseudo_inverse(G)
        one = jnp.eye(len(f), dtype=M.dtype)
        P = one - matmat(inverse, G)
        a = matvec(inverse, c)
        H = matmat(P, matmat(M, P)) + one - P
        a = a + matvec(P, solve_positive(H, matvec(P, f - matvec(M, a))))
        return a, matvec(inverse.T, matvec(M, a) - f)


@dataclass(frozen=True)
class AugmentedLagrangian(Dense):
    """Index 0, by iterated penalties on accelerations, from a_0 = M^-1 f:

        (M + alpha G^T G) a_{i+1} = M a_i + alpha G^T c
        G a_{i+1} - c = (1 + alpha G M^-1 G^T)^-1 (G a_i - c),     l = sum of alpha (c - G a_i)
    The method needs no rank. Each iterate satisfies M a = f + G^T l. The derivative has the
    truncation error of the iteration.

    Fields:
        alpha: penalty of the scaled equations.
        iterations: number of iterations.

    Source: Bayo, Garcia de Jalon & Serna 1988; Masarati 9.2.
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
            penalty = l + self.alpha * (c - matvec(G, a))
            force = f - matvec(M, a) + matvec(G.T, penalty)
            a = a + jax.scipy.linalg.cho_solve(factors, force)
            l = l + self.alpha * (c - matvec(G, a))
        return a, l
