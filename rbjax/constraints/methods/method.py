"""Methods that solve the equations of constrained motion for the accelerations.

A method is one factor of a `Formulation`. It is hashable and a compile-time constant.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar

import jax

from rbjax.arguments import integer, real_number
from rbjax.constraints.equations.constrained_motion import constrained_motion
from rbjax.constraints.equations.model_rows import add_multipliers, rows_of
from rbjax.dynamics.algorithms.aba import acceleration
from rbjax.dynamics.algorithms.rnea import LinkForces
from rbjax.dynamics.drivers.choice import driver
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.lanes import add, mul, neg
from rbjax.model import Model, State


@dataclass(frozen=True)
class Factor:
    """Base class of the choices that make up a formulation: method, feedback and projection. It is
    a frozen dataclass whose parameters are checked."""

    def __post_init__(self) -> None:
        """Raise InputError unless floats are at least 0 and integers at least 1."""
        name = type(self).__name__
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.type == "float" and not isinstance(value, jax.core.Tracer):
                if isinstance(value, bool):
                    raise InputError(
                        f"{name}: {field.name} is {value!r}, expected a number of at least 0"
                    )
                real_number(name, field.name, value, least=0.0)
            if field.type == "int" or (field.type == "int | None" and value is not None):
                integer(name, field.name, value, least=1)


@dataclass(frozen=True)
class Method(Factor):
    """Base class of methods for constrained motion. Subclasses are frozen dataclasses.

    Class fields:
        name: key in `rb.constraints.formulations()`.
        family: "minimal", "redundant" or "unconstrained" (Masarati 7, 8, 9).
        index: index of the differential-algebraic equations; 0 without multipliers.
        has_feedback: whether `Baumgarte` applies to the method.
    """

    name: ClassVar[str]
    family: ClassVar[str]
    index: ClassVar[int]
    has_feedback: ClassVar[bool] = True

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces,
        alpha: Any = 0.0, beta: Any = 0.0,
    ) -> jax.Array:  # fmt: skip
        """Compute v' (nv,) such that g'' = -2 alpha g' - beta^2 g."""
        raise NotImplementedError(f"{type(self).__name__} has no accelerations")

    def projected_rows(self, model: Model) -> Model:
        """Return the model with only the constraints that a projection enforces."""
        return model


@dataclass(frozen=True)
class Multipliers(Method):
    """Index 1, by the range-space method: A l = c - G a_f, with the factors of ABA.

    Source: Masarati 8.3; Carpentier, Budhiraja & Mansard 2021.
    """

    name: ClassVar[str] = "multipliers"
    family: ClassVar[str] = "redundant"
    index: ClassVar[int] = 1

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        return constrained_motion(model, t, state, tau, f_ext, alpha, beta)[0]


@dataclass(frozen=True)
class Penalty(Method):
    """Index 0, with stiff springs and dampers instead of constraints:

        M a + b = tau - G^T (k g + d g')
    This is a singular perturbation: in slow motion the residual is -l / k, and frequencies grow as
    sqrt(k). Non-holonomic rows have only the damper.

    Fields:
        stiffness: k, N/m or N m, depending on the row.
        damping: d, N s/m or N m s.

    Source: Lötstedt 1979; Masarati 8.2.
    """

    stiffness: float = 1e6
    damping: float = 1e3
    name: ClassVar[str] = "penalty"
    family: ClassVar[str] = "unconstrained"
    index: ClassVar[int] = 0
    has_feedback: ClassVar[bool] = False

    def __call__(self, model, t, state, tau, f_ext, alpha=0.0, beta=0.0):
        d = driver(model, state.q.dtype)
        context = Context.of(model, t, state, None, d=d)
        _ = context.links.joints  # evaluated first, because the driver reads its lanes
        rows = rows_of(model, context)
        k, c = self.stiffness, self.damping
        l = [neg(add(mul(k, row.residual), mul(c, row.rate))) for row in rows]
        tau, f_ext = add_multipliers(d, rows, l, tau, f_ext)
        return acceleration(model, state.q, state.v, tau, f_ext)
