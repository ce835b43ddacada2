"""Formulations that keep all coordinates and have no multipliers: the unconstrained family.

The constraints become forces that are functions of the state, so any method for ordinary
differential equations takes what is left. (Masarati, *Multibody System Dynamics*, ch. 8)
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.system import rows_of, with_multipliers
from rbjax.constraints.methods.dense import Dense, Solution, pseudo_inverse, solve_positive
from rbjax.constraints.methods.method import Method
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.forward import acceleration
from rbjax.dynamics.drivers.choice import driver
from rbjax.forces.context import Context
from rbjax.lanes import Lane, add, mul, neg
from rbjax.lanes.arrays import matmat, matvec


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


@dataclass(frozen=True)
class Penalty(Method):
    """Index 0, by stiff springs and dampers in the place of constraints:

        M a + b = tau - G^T (k g + d g')
    A singular perturbation: the residual is -l / k where motion is slow, and frequencies grow as
    sqrt(k). A row with only a rate has only the damper.

    Fields: stiffness k, N/m or N m by row; damping d, N s/m or N m s.

    Source: Lötstedt 1979; Masarati, ch. 8.
    """

    stiffness: float = 1e6
    damping: float = 1e3
    name: ClassVar[str] = "penalty"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0
    has_feedback: ClassVar[bool] = False

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        d = driver(model, state.q.dtype)
        now = Context.of(model, t, state, None, d=d)
        _ = now.links.joints  # a driver learns from them what its lanes are
        rows = rows_of(model, now)
        l = [neg(self._force(row)) for row in rows]
        tau, f_ext = with_multipliers(d, rows, l, tau, f_ext)
        return acceleration(model, state.q, state.v, tau, f_ext)

    def _force(self, row: Row) -> Lane:
        return add(mul(self.stiffness, row.residual), mul(self.damping, row.rate))
