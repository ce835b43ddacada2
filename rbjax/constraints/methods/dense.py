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
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.law import Solve, System, constrained_motion
from rbjax.constraints.equations.system import as_free_bodies, gradient_matrix
from rbjax.constraints.methods.method import Method
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.crba import crba
from rbjax.dynamics.algorithms.link_forces import LinkForces
from rbjax.dynamics.algorithms.rnea import rnea
from rbjax.dynamics.drivers.choice import Driver
from rbjax.dynamics.drivers.packing import pack
from rbjax.forces.context import Context
from rbjax.lanes import Lane
from rbjax.lanes.arrays import matmat, matvec
from rbjax.lanes.factorization import VANISHING, least

#: singular values below it, of the largest, are zero, by bytes of a number
NEGLIGIBLE = {4: 1e-2, 8: float(np.sqrt(np.finfo(float).eps))}
#: what is added to the square of a row's length, relative to that of free bodies
SHORT = {4: 1.0, 8: VANISHING[8]}
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
        squares = squares + least(squares, usual, SHORT[G.dtype.itemsize], root)
        r = 1.0 / jnp.sqrt(jnp.where(squares > 0, squares, 1.0))
        a, l = self.solution(s[:, None] * M * s, r[:, None] * G, s * f, r * c)
        return s * a, r * l


def inverted(x: jax.Array, power: int = 1) -> jax.Array:
    """1 / x where x, against the largest of them, is above `NEGLIGIBLE` to a power, else 0: of
    numbers that a rank is decided by."""
    size = jnp.abs(x)
    held = size > NEGLIGIBLE[x.dtype.itemsize] ** power * size.max()
    return jnp.where(held, 1.0 / jnp.where(held, x, 1.0), 0.0)


def pseudo_inverse(A: jax.Array) -> jax.Array:
    """A^+ (n, m), by the singular values of A (m, n)."""
    U, s, Vt = jnp.linalg.svd(A, full_matrices=False)
    return matmat(Vt.T * inverted(s), U.T)


def solve_positive(A: jax.Array, b: jax.Array) -> jax.Array:
    """x of A x = b, A symmetric and positive definite."""
    return jax.scipy.linalg.cho_solve(jax.scipy.linalg.cho_factor(A), b)
