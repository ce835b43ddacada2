"""Formulations of index 2 and 3: the equations of motion and the constraints themselves, together.

    q' = v + M^-1 G^T mu,     M v' + b = tau + sum of J_i^T f_i + G^T l
    index 2    G v + g_t = 0                  velocities hold; positions drift by the step's error
    index 3    g(t, q) = 0                    positions hold; velocities to the order of the step
    GGL        both, the first by mu          index 2, nothing drifts
(mu is zero but in GGL, where it is zero but for the step's error.) A non-holonomic row has only a
rate, which all of them hold. Implicit methods step these equations as they stand, by residuals
through RNEA: no mass matrix is inverted.
(Gear, Leimkuhler & Gupta, *Automatic integration of Euler-Lagrange equations with constraints*,
1985; Hairer & Wanner, *Solving Ordinary Differential Equations II*, VII; Masarati, ch. 7.)

Singular positions are passed in f64: ten seconds of a
parallelogram, some fifteen passages, are as accurate as the steps, wherever stages fall, and also
if every joint is given twice (redundant rows). In f32 only GGL passes them: index 2 does not
correct positions, and the rows of index 3 carry the rounding of positions divided by the square of
the step, and again by the singular value.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.constrained_motion import as_free_bodies, constrained_motion
from rbjax.constraints.equations.model_rows import rows_of, with_multipliers
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
    """A formulation whose equations an implicit method steps: Radau IIA of three stages, or another
    one given as `integrator=` of `rollout` or `solver=` of `simulate`.

    As a dynamics it gives the accelerations of index 1, which are those of consistent states. A
    step whose equations are not solved is a value: `Trajectory.ok` is False, and adaptive steps
    become shorter. `Projection` puts states back on all levels after steps.

    Example:
        >>> import rbjax as rb
        >>> [rb.constraints.formulations()[x].index for x in ("index_2", "index_3", "ggl")]
        [2, 3, 2]
    """

    family: ClassVar[str] = "redundant"
    has_feedback: ClassVar[bool] = False

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        return constrained_motion(model, t, state, tau, f_ext)[0]

    def held(self, row: Row) -> tuple[Lane, int]:
        """The quantity that is zero (g or g'), and the number of integrations from acceleration to
        it (2 or 1)."""
        raise NotImplementedError(f"{type(self).__name__} has no method held(row)")

    def held_by_mu(self, rows: Sequence[Row]) -> list[Row]:
        """The rows whose values mu holds."""
        return []

    @property
    def damping(self) -> DifferentialAlgebraic:
        """The formulation whose equations an estimate of the error is damped by."""
        return self

    def algebraic(
        self, model: Model, t: Any, state: State
    ) -> tuple[tuple[int, ...], jax.Array, int]:
        """The depth of each algebraic equation (integrations from acceleration), the scale of its
        diagonal (`as_free_bodies`), and the number of GGL rows."""
        d = driver(model, state.q.dtype)
        now = Context.of(model, t, state, None, d=d)
        _ = now.links.joints  # a driver learns from them what its lanes are
        rows = rows_of(model, now)
        again = self.held_by_mu(rows)
        usual = [as_free_bodies(d, row) for row in (*rows, *again)]
        depth = (*(self.held(row)[1] for row in rows), *[1] * len(again))
        return depth, pack(usual, state.v), len(again)

    def equations(self, model: Model, q: jax.Array, forces: Forces) -> Callable[..., jax.Array]:
        """0 = f(t, y, y', w) of y = (u, v, x), w = (l, mu): the configuration is q (+) u."""
        nv, dtype = model.nv, q.dtype

        def f(t: Any, y: jax.Array, rate: jax.Array, w: jax.Array) -> jax.Array:
            (u, v, x), (du, a, dx) = (jnp.split(z, (nv, 2 * nv)) for z in (y, rate))
            at = State(retract(model, q, u), v, x if model.nx else None)
            tau, f_ext, x_rate = forces(t, at)
            d = driver(model, dtype)
            now = Context.of(model, t, at, None, d=d)
            rows = rows_of(model, now)
            l, mu = list(w[: len(rows)]), list(w[len(rows) :])
            tau, f_ext = with_multipliers(d, rows, l, tau, f_ext)
            needed = rnea(d, now.links.joints, d.lanes(a), d.prepared.gravity, f_ext)
            drift = du - increment_rate(model, u, v)
            values = self.held_by_mu(rows)
            if values:
                drift = _pushed(d, at.q, drift, values, mu)
            off = [self.held(row)[0] for row in rows] + [row.residual for row in values]
            parts = [drift, d.pack(needed, tau) - tau, pack(off, v)]
            if x_rate is not None:
                parts.insert(2, dx - x_rate)
            return jnp.concatenate(parts)

        return f


def _pushed(
    d: Driver, q: jax.Array, x: jax.Array, rows: Sequence[Row], mu: Sequence[Lane]
) -> jax.Array:
    """M x - G^T mu."""
    tau, f_ext = with_multipliers(d, rows, mu, jnp.zeros_like(x), {})
    return d.pack(rnea(d, d.joints(q, None), d.lanes(x), Vec3.zero(), f_ext), x) - tau


def _rate(row: Row) -> tuple[Lane, int]:
    return row.rate, 1


@dataclass(frozen=True)
class Index2(DifferentialAlgebraic):
    """G v + g_t = 0 at the stages of each step. Positions drift by the error of the steps, in f32
    so far that motions leave their branch at singular positions.

    Radau IIA of s stages: order 2 s - 1, multipliers s. Lobatto IIIC: 2 s - 2, multipliers s - 1.
    BDF k: k, multipliers too. Gauss: velocities s, or s + 1 where s is odd.

    Source: Hairer, Lubich & Roche 1989; Hairer & Wanner, II, VII.4.
    """

    name: ClassVar[str] = "index_2"
    index: ClassVar[int] = 2

    def held(self, row: Row) -> tuple[Lane, int]:
        return _rate(row)


@dataclass(frozen=True)
class Index3(DifferentialAlgebraic):
    """g(t, q) = 0 at the stages of each step. Velocities hold to their order.

    Radau IIA of s stages: order of positions 2 s - 1, velocities s, multipliers s - 1. BDF k: k.
    Gauss methods do not converge in velocities where s = 2. In f32 a step must not be short:
    velocities carry the rounding of positions divided by it, and singular positions are not passed
    (`ok` is False). Adaptive steps look at velocities along the constraints only.

    Source: as `Index2`; VII.8.
    """

    name: ClassVar[str] = "index_3"
    index: ClassVar[int] = 3

    def held(self, row: Row) -> tuple[Lane, int]:
        return (row.residual, 2) if row.holonomic else _rate(row)

    @property
    def damping(self) -> DifferentialAlgebraic:
        """Across the constraints a velocity is off by the error of the step before, however short
        this one is."""
        return GGL()


@dataclass(frozen=True)
class GGL(DifferentialAlgebraic):
    """Gear, Gupta and Leimkuhler's: index 2, with a second multiplier that holds g(t, q) = 0 too.

        M (q' - v) = G^T mu,    G v + g_t = 0,    g(t, q) = 0
    Orders of stiffly accurate methods (Radau IIA, Lobatto IIIC, BDF) are those of index 2. Gauss
    methods end their steps off the constraints.

    Source: Gear, Leimkuhler & Gupta 1985.
    """

    name: ClassVar[str] = "ggl"
    index: ClassVar[int] = 2

    def held(self, row: Row) -> tuple[Lane, int]:
        return _rate(row)

    def held_by_mu(self, rows: Sequence[Row]) -> list[Row]:
        return [row for row in rows if row.holonomic]
