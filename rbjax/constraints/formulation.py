"""Formulations: how the constraints of a model are enforced.

A formulation combines three independent factors:

    method        solves the equations of constrained motion for the accelerations
    feedback      none, or Baumgarte's: g'' = -2 alpha g' - beta^2 g
    projection    none; after each step (`Projection`); or at each stage (`TangentSpace`,
                  `IndependentCoordinates`)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import jax

from rbjax.constraints.equations.projection import (
    project_state,
    project_to_tangent_space,
    solve_dependent,
)
from rbjax.constraints.methods.dense import (
    KKT,
    AugmentedLagrangian,
    ForceProjection,
    NullSpaceQR,
    NullSpaceSVD,
    Partitioning,
    UdwadiaKalaba,
)
from rbjax.constraints.methods.differential_algebraic import (
    GGL,
    DifferentialAlgebraic,
    Index2,
    Index3,
)
from rbjax.constraints.methods.method import Factor, Method, Multipliers, Penalty
from rbjax.constraints.methods.recursive import Recursive
from rbjax.constraints.methods.soft import Compliant
from rbjax.constraints.rows import couplings, curve, functions, pairs, rolling, tendons
from rbjax.constraints.rows.pairs import QuaternionWeld
from rbjax.constraints.rows.row import Constraint
from rbjax.constraints.rows.soft import Soft, is_soft
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model, State

MULTIPLIERS = Multipliers()


@dataclass(frozen=True)
class Baumgarte(Factor):
    """Baumgarte stabilization: feedback of the residual, g'' + 2 alpha g' + beta^2 g = 0.

    Fields:
        alpha: damping, 1/s. The feedback is critically damped if alpha = beta.
        beta: frequency, 1/s.

    With an explicit integrator of step dt, choose alpha so that alpha dt is well below 1.

    Source: Baumgarte 1972; Masarati 8.4.
    """

    alpha: float = 20.0
    beta: float = 20.0
    name: ClassVar[str] = "baumgarte"

    @classmethod
    def for_step(cls, dt: float) -> Baumgarte:
        """Return the best feedback for semi-implicit Euler steps dt without projection.

        The gains alpha = 1 / (2 dt) and beta = 0.3 / dt give G v+ = -0.09 g / dt. Integrators with
        stages need alpha and beta well below 1 / dt.

        Source: Anitescu & Potra 1997 (constraints on the velocity after a step).
        """
        if not (isinstance(dt, int | float) and 0 < dt < math.inf):
            raise InputError(f"Baumgarte.for_step: dt is {dt!r}, expected a positive step, s")
        return cls(0.5 / dt, 0.3 / dt)


@dataclass(frozen=True)
class Projection(Factor):
    """Projection of the state on the constraints after each step.

    The change of positions and velocities is the least one in the norm of the mass matrix.

    Fields:
        iterations: number for positions and for velocities; 2 in f64 and 1 in f32 if None.

    Source: Masarati 9.3.3 (drift eliminated at position level).
    """

    iterations: int | None = None
    name: ClassVar[str] = "projected"

    def project(self, model: Model, t: Any, state: State) -> State:
        """Return the nearest state on the constraints. The result is differentiable."""
        return project_state(model, t, state, self.iterations)

    def stage_state(self, model: Model, t: Any, state: State, t0: Any, start: State) -> State:
        """Return the stage state unchanged: this projection acts only after a step."""
        return state


@dataclass(frozen=True)
class StageProjection(Factor):
    """Base class of projections at each stage of a step. Subclasses are frozen dataclasses.

    `simulate` and the Runge-Kutta methods of `rollout` project at each stage. Other integrators
    project after each step.

    Fields:
        iterations: number of Newton iterations; 5 in f64 and 3 in f32 if None.
    """

    iterations: int | None = None

    def stage_state(self, model: Model, t: Any, state: State, t0: Any, start: State) -> State:
        """Return the state at which a Runge-Kutta stage evaluates rates, in a step from time t0 and
        state `start`."""
        raise NotImplementedError(f"{type(self).__name__} has no method stage_state")

    def project(self, model: Model, t: Any, state: State) -> State:
        """Return the projected state after a step. The result is differentiable."""
        return self.stage_state(model, t, state, t, state)


@dataclass(frozen=True)
class TangentSpace(StageProjection):
    """Projection at each stage that keeps the components in the tangent space at the step's start.

    The accelerations of each stage belong to a consistent state. Use it if forces or rows are
    undefined off the constraints, or to reproduce steps in minimal coordinates. Otherwise
    `Projection` costs less. The two agree to the order of the integrator.

    Source: Mani, Haug & Atkinson 1985; Hairer, Lubich & Wanner, IV.5.3; Masarati 7.1.3.
    """

    name: ClassVar[str] = "tangent_space"

    def project(self, model: Model, t: Any, state: State) -> State:
        return project_state(model, t, state)

    def stage_state(self, model: Model, t: Any, state: State, t0: Any, start: State) -> State:
        return project_to_tangent_space(model, t, state, t0, start, self.iterations)


@dataclass(frozen=True)
class IndependentCoordinates(StageProjection):
    """Coordinate partitioning: integration of the independent coordinates only.

    At each stage the dependent coordinates and their velocities are solved from the constraints.
    Each step chooses its partition at its start by elimination with full pivoting. The named
    formulation "partitioning" is the method `Partitioning` with this projection.

    Source: Wehage & Haug 1982; Masarati 7.1.1.
    """

    name: ClassVar[str] = "independent_coordinates"

    def stage_state(self, model: Model, t: Any, state: State, t0: Any, start: State) -> State:
        return solve_dependent(model, t, state, t0, start, self.iterations)


@dataclass(frozen=True)
class Formulation:
    """How constraints are enforced: a method, a feedback and a projection.

    A formulation is a `Dynamics`, (model, t, state, tau, f_ext) -> v' (nv,). Pass it to
    `rb.rollout` or `rb.simulate` as `constraints=`. They also accept a single factor, and use the
    defaults of this class for the other two.

    Example:
        >>> from rbjax.constraints import KKT, Baumgarte, Formulation, Projection
        >>> both = Formulation(KKT(), Baumgarte(10.0, 10.0), Projection())
        >>> both.name, both.family, both.index
        ('kkt+baumgarte+projected', 'redundant', 1)
    """

    method: Method = MULTIPLIERS
    feedback: Baumgarte | None = None
    projection: Projection | StageProjection | None = None

    def __post_init__(self) -> None:
        for name, kinds in (
            ("method", (Method,)),
            ("feedback", (Baumgarte, type(None))),
            ("projection", (Projection, StageProjection, type(None))),
        ):
            value = getattr(self, name)
            if not isinstance(value, kinds):
                known = " or ".join(x.__name__ for x in kinds).replace("NoneType", "None")
                raise InputError(f"Formulation({name}=...): got {value!r}, expected {known}")
        if self.feedback is not None and not self.method.has_feedback:
            raise InputError(
                f"Formulation: {type(self.method).__name__} has no feedback of residuals; leave "
                "feedback out"
            )

    @property
    def name(self) -> str:
        """Names of the factors that are not the default, joined by "+"."""
        factors: tuple[Any, ...] = () if self.method == MULTIPLIERS else (self.method,)
        factors += tuple(x for x in (self.feedback, self.projection) if x is not None)
        return "+".join(x.name for x in factors or (self.method,))

    @property
    def family(self) -> str:
        """Family of the method, or "minimal" (Masarati 7) with a projection at each stage."""
        return "minimal" if isinstance(self.projection, StageProjection) else self.method.family

    @property
    def index(self) -> int:
        """Differential index of the method, or 0 with a projection at each stage."""
        return 0 if isinstance(self.projection, StageProjection) else self.method.index

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> jax.Array:
        """Compute v' (nv,), with the signature of `rbjax.motion.field.Dynamics`."""
        x = self.feedback
        gains = () if x is None else (x.alpha, x.beta)
        return self.method(model, t, state, tau, f_ext, *gains)

    def stage_state(self, model: Model, t: Any, state: State, t0: Any, start: State) -> State:
        """Return the state at which a Runge-Kutta stage evaluates rates, in a step from time t0 and
        state `start`. Integrators also call it on the state at the end of a step, before `project`.
        """
        if self.projection is None:
            return state
        return self.projection.stage_state(model, t, state, t0, start)

    def project(self, model: Model, t: Any, state: State) -> State:
        """Return the state from which the next step starts."""
        if self.projection is None:
            return state
        model = self.method.projected_rows(model)
        return self.projection.project(model, t, state) if model.constraints else state


def as_formulation(x: Any) -> Formulation | None:
    """Convert a factor to a formulation. Return a formulation as it is, and None for other
    types."""
    if isinstance(x, Formulation):
        return x
    if isinstance(x, Method):
        return Formulation(x)
    if isinstance(x, Baumgarte):
        return Formulation(feedback=x)
    return Formulation(projection=x) if isinstance(x, Projection | StageProjection) else None


def differential_algebraic_method(dynamics: Any) -> DifferentialAlgebraic | None:
    """Return the method of index 2 or 3 that an implicit integrator must step, or None."""
    method = dynamics.method if isinstance(dynamics, Formulation) else dynamics
    return method if isinstance(method, DifferentialAlgebraic) else None


DEFAULT = Formulation(projection=Projection())
#: methods that the registry contains without feedback and under their own names
METHODS: tuple[Method, ...] = (
    KKT(), NullSpaceQR(), NullSpaceSVD(), Partitioning(), Recursive(), UdwadiaKalaba(),
    ForceProjection(), AugmentedLagrangian(), Penalty(), Index2(), Index3(), GGL(),
)  # fmt: skip
_FORMULATIONS: dict[str, Formulation] = {
    "projected": DEFAULT,
    "multipliers": Formulation(),
    "baumgarte": Formulation(feedback=Baumgarte()),
    "tangent_space": Formulation(projection=TangentSpace()),
    **{method.name: Formulation(method) for method in METHODS},
    "partitioning": Formulation(Partitioning(), projection=IndependentCoordinates()),
    "compliant": Formulation(Compliant(), projection=Projection()),
}


def formulations() -> dict[str, Formulation]:
    """Return all named formulations: each method, and the usual feedbacks and projections.

    | name | method | family | index | equation |
    |---|---|---|---|---|
    | projected | multipliers | redundant | 1 | with a projection after each step (the default) |
    | multipliers | multipliers | redundant | 1 | A l = c - G a_f by the factors of ABA |
    | baumgarte | multipliers | redundant | 1 | with feedback of the residual |
    | tangent_space | multipliers | minimal | 0 | with a projection at each stage |
    | kkt | kkt | redundant | 1 | a and l in one linear system |
    | null_space_qr | the same | minimal | 0 | a = L c + Z z, with Z of a pivoted QR |
    | null_space_svd | the same | minimal | 0 | a = L c + Z z, with Z of the singular vectors |
    | partitioning | the same | minimal | 0 | only independent coordinates are integrated |
    | recursive | the same | minimal | 0 | multipliers, loop by loop along the tree |
    | udwadia_kalaba | the same | unconstrained | 0 | the least change of a_f |
    | force_projection | the same | unconstrained | 0 | forces without their part along the rows |
    | augmented_lagrangian | the same | unconstrained | 0 | penalties on accelerations, iterated |
    | penalty | the same | unconstrained | 0 | stiff springs: an approximation |
    | index_2 | the same | redundant | 2 | G v + g_t = 0 at the stages of implicit methods |
    | index_3 | the same | redundant | 3 | g = 0 at the stages of implicit methods |
    | ggl | the same | redundant | 2 | both, with a second multiplier for g = 0 |
    | compliant | the same | unconstrained | 0 | soft rows by MuJoCo's model, rigid rows projected |

    Any method combines with any projection, and most methods with feedback:
    `Formulation(KKT(), Baumgarte(), Projection())`. The dense methods, from "kkt" to
    "augmented_lagrangian" except "recursive", cost O(nv^3 + rows^3). Use them for comparison and
    for small mechanisms. All but "penalty" and "compliant" give the same accelerations;
    "augmented_lagrangian" to 1e-5 of its correction. "compliant" is the default if a model has a
    `Soft` constraint.

    Example:
        >>> import rbjax as rb
        >>> rb.constraints.formulations()["baumgarte"].index
        1
    """
    return dict(_FORMULATIONS)


def kinds() -> dict[str, type[Constraint]]:
    """Return the constraint classes of rbjax by name.

    Example:
        >>> import rbjax as rb
        >>> rb.constraints.kinds()["Weld"].size
        6
    """
    rooms = pairs, couplings, curve, functions, rolling, tendons
    every = (x for room in rooms for x in vars(room).values() if isinstance(x, type))
    bases = Constraint, pairs.Pair, pairs.HalfAngle, rolling.RollingWheel
    found = {x.__name__: x for x in every if issubclass(x, Constraint) and x not in bases}
    return found | {x.__name__: x for x in (QuaternionWeld, Soft)}


def formulation_of(where: str, model: Model, given: Any) -> Formulation | None:
    """Return the formulation of a model, or None if it has no constraints. `given` is a name, a
    `Formulation`, one of its factors, or None for the default."""
    if not model.constraints:
        if given is not None:
            raise InputError(
                f"{where}: constraints={given!r}, and the model has none; "
                "model.with_constraints(...) adds some"
            )
        return None
    if given is None:
        return _FORMULATIONS["compliant"] if is_soft(model) else DEFAULT
    found = as_formulation(given)
    if found is not None:
        return found
    if isinstance(given, str) and given in _FORMULATIONS:
        return _FORMULATIONS[given]
    raise UnknownName("formulation", given, _FORMULATIONS)
