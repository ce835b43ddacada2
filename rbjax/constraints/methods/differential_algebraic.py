"""Formulations of index 2 and 3: the equations of motion together with the constraints.

    q' = v + M^-1 G^T mu,     M v' + b = tau + sum of J_i^T f_i + G^T l
    index 2    G v + g_t = 0                  positions drift by the error of the steps
    index 3    g(t, q) = 0                    velocities satisfy G v + g_t = 0 to the step's order
    GGL        both, the second by mu         index 2, no drift
Only GGL has mu, which has the size of the step's error. A non-holonomic row is G v + b = 0 in all
three. Implicit methods solve these equations by residuals through RNEA, without M^-1.

In f64 the steps pass through singular positions (`rbjax.solvers.constrained.schur_complement`),
also with redundant rows. In f32 only GGL does.

Source: Gear, Leimkuhler & Gupta 1985; Hairer & Wanner, *Solving Ordinary Differential Equations
II*, VII; Masarati 8.3.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.constrained_motion import constrained_motion, free_body_diagonal
from rbjax.constraints.equations.model_rows import add_multipliers, rows_of
from rbjax.constraints.methods.method import Method
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.manifold import increment_rate, retract
from rbjax.dynamics.algorithms.rnea import LinkForces, rnea
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.forces.context import Context
from rbjax.lanes import Lane, Vec3
from rbjax.lanes.arrays import pack
from rbjax.model import Model, State

#: (t, state) -> generalized forces (nv,), forces on links, x'
Forces = Callable[[Any, State], tuple[jax.Array, LinkForces, jax.Array | None]]


@dataclass(frozen=True)
class DifferentialAlgebraic(Method):
    """Base class of methods whose equations are solved by implicit steps.

    The integrator is Radau IIA of three stages, or another implicit one of `rollout` or `simulate`.
    If the equations of a step are not solved, `Trajectory.success` is False, and adaptive steps
    become shorter. Called as a `Dynamics`, the method returns the accelerations of index 1.

    Example:
        >>> import rbjax as rb
        >>> [rb.constraints.formulations()[x].index for x in ("index_2", "index_3", "ggl")]
        [2, 3, 2]
    """

    family: ClassVar[str] = "redundant"
    has_feedback: ClassVar[bool] = False

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        return constrained_motion(model, t, state, tau, f_ext)[0]

    def level_of(self, row: Row) -> tuple[Lane, int]:
        """Return the residual of a row that the stages satisfy, g or g', and its depth.

        The depth is the number of integrations from the acceleration to this residual: 2 for g, 1
        for g'.
        """
        raise NotImplementedError(f"{type(self).__name__} has no method level_of(row)")

    def position_rows(self, rows: Sequence[Row]) -> list[Row]:
        """Return the rows with an additional multiplier mu for g = 0 (GGL only)."""
        return []

    @property
    def damping(self) -> DifferentialAlgebraic:
        """The formulation whose linearised equations filter the error estimate; this one."""
        return self

    def algebraic(
        self, model: Model, t: Any, state: State
    ) -> tuple[tuple[int, ...], jax.Array, int]:
        """Describe the algebraic equations of a model.

        Returns:
            The depth of each residual (the number of integrations from the acceleration to it), the
            `free_body_diagonal` (m,) of the equations, and the number of GGL rows.
        """
        d = driver(model, state.q.dtype)
        context = Context.of(model, t, state, None, d=d)
        _ = context.links.joints  # evaluated first, because the driver reads its lanes
        rows = rows_of(model, context)
        ggl = self.position_rows(rows)
        free_diagonal = [free_body_diagonal(d, row) for row in (*rows, *ggl)]
        depth = (*(self.level_of(row)[1] for row in rows), *[1] * len(ggl))
        return depth, pack(free_diagonal, state.v), len(ggl)

    def equations(self, model: Model, q: jax.Array, forces: Forces) -> Callable[..., jax.Array]:
        """Return the function f of the equations f(t, y, y', w) = 0 of constrained motion. y = (u,
        v, x) contains the displacement u from the configuration q, the velocity and the states of
        force elements. w = (l, mu) contains the multipliers."""
        nv, dtype = model.nv, q.dtype

        def f(t: Any, y: jax.Array, rate: jax.Array, w: jax.Array) -> jax.Array:
            (u, v, x), (du, a, dx) = (jnp.split(z, (nv, 2 * nv)) for z in (y, rate))
            at = State(retract(model, q, u), v, x if model.nx else None)
            tau, f_ext, x_rate = forces(t, at)
            d = driver(model, dtype)
            context = Context.of(model, t, at, None, d=d)
            rows = rows_of(model, context)
            l, mu = list(w[: len(rows)]), list(w[len(rows) :])
            tau, f_ext = add_multipliers(d, rows, l, tau, f_ext)
            needed = rnea(d, context.links.joints, d.lanes(a), d.prepared.gravity, f_ext)
            drift = du - increment_rate(model, u, v)
            values = self.position_rows(rows)
            if values:
                drift = _with_ggl_forces(d, at.q, drift, values, mu)
            residuals = [self.level_of(row)[0] for row in rows] + [row.residual for row in values]
            parts = [drift, d.pack(needed, tau) - tau, pack(residuals, v)]
            if x_rate is not None:
                parts.insert(2, dx - x_rate)
            return jnp.concatenate(parts)

        return f


def _with_ggl_forces(
    d: Driver, q: jax.Array, x: jax.Array, rows: Sequence[Row], mu: Sequence[Lane]
) -> jax.Array:
    """Return M x - G^T mu, the residual of the kinematic equation of GGL.
    x is the difference of rate and velocity, and mu the multipliers of `rows`."""
    tau, f_ext = add_multipliers(d, rows, mu, jnp.zeros_like(x), {})
    return d.pack(rnea(d, d.joints(q, None), d.lanes(x), Vec3.zero(), f_ext), x) - tau


def _rate(row: Row) -> tuple[Lane, int]:
    return row.rate, 1


@dataclass(frozen=True)
class Index2(DifferentialAlgebraic):
    """Index 2: G v + g_t = 0 at the stages of each step. Positions drift by the error of the steps.

    Orders of convergence:

        Radau IIA of s stages       2 s - 1; multipliers s
        Lobatto IIIC of s stages    2 s - 2; multipliers s - 1
        BDF of order k              k, also for multipliers
        Gauss of s stages           velocities s, or s + 1 if s is odd

    Source: Hairer, Lubich & Roche 1989; Hairer & Wanner, II, VII.4.
    """

    name: ClassVar[str] = "index_2"
    index: ClassVar[int] = 2

    def level_of(self, row: Row) -> tuple[Lane, int]:
        return _rate(row)


@dataclass(frozen=True)
class Index3(DifferentialAlgebraic):
    """Index 3: g(t, q) = 0 at the stages of each step.

    Radau IIA of s stages has order 2 s - 1 in positions, s in velocities and s - 1 in multipliers.
    BDF of order k has order k. Gauss methods of two stages do not converge in velocities. In f32
    avoid short steps: velocities have the rounding error of positions divided by the step. Adaptive
    steps control only velocities along the constraints.

    Source: Hairer, Lubich & Roche 1989; Hairer & Wanner, II, VII.8.
    """

    name: ClassVar[str] = "index_3"
    index: ClassVar[int] = 3

    def level_of(self, row: Row) -> tuple[Lane, int]:
        return (row.residual, 2) if row.holonomic else _rate(row)

    @property
    def damping(self) -> DifferentialAlgebraic:
        """The formulation whose linearised equations filter the error estimate: `GGL`.

        With the equations of index 3, errors of velocity normal to the constraints would remain in
        the estimate of short steps.
        """
        return GGL()


@dataclass(frozen=True)
class GGL(DifferentialAlgebraic):
    """Gear-Gupta-Leimkuhler formulation: index 2, with a second multiplier for g(t, q) = 0.

        M (q' - v) = G^T mu,    G v + g_t = 0,    g(t, q) = 0
    Stiffly accurate methods (Radau IIA, Lobatto IIIC, BDF) have the orders of index 2. Gauss
    methods do not satisfy the constraints at the end of a step.

    Source: Gear, Leimkuhler & Gupta 1985.
    """

    name: ClassVar[str] = "ggl"
    index: ClassVar[int] = 2

    def level_of(self, row: Row) -> tuple[Lane, int]:
        return _rate(row)

    def position_rows(self, rows: Sequence[Row]) -> list[Row]:
        return [row for row in rows if row.holonomic]
