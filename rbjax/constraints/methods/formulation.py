"""Formulations: how constraints are enforced, as a law of motion that may mend the state it moves.

A formulation is a law (from forces to accelerations), a `settled`: what becomes of a state after
each step, and a `staged`: where within a step its rates are taken. It is hashable, and is part of
the program.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Any, ClassVar

import jax

from rbjax.arguments import real_number
from rbjax.constraints.equations.law import constrained_motion
from rbjax.constraints.equations.projection import projected
from rbjax.dynamics.algorithms.link_forces import LinkForces
from rbjax.errors import InputError
from rbjax.model import Model, State


@dataclass(frozen=True)
class Formulation:
    """Accelerations of constrained motion. Make a frozen dataclass of it: its fields are its
    numbers.

    Class fields: name; family, "minimal", "redundant" or "unconstrained" (Masarati, ch. 8); index,
    of the differential-algebraic equations that it solves (0 where no multipliers are left).
    """

    name: ClassVar[str]
    family: ClassVar[str]
    index: ClassVar[int]

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            _check(f"{type(self).__name__}({field.name}=...)", field, getattr(self, field.name))

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, pushes: LinkForces
    ) -> jax.Array:
        """v' (nv,), as `rbjax.motion.field.Law`."""
        raise NotImplementedError(f"{type(self).__name__} has no accelerations")

    def staged(self, model: Model, t: Any, state: State, t0: Any, start: State) -> State:
        """The state at which a stage's rates are taken, of a step that began at t0 in `start`; and
        the state that the step ends with, before it is settled."""
        return state

    def settled(self, model: Model, t: Any, state: State) -> State:
        """The state after a step, as the next one starts from it."""
        return state


def _check(where: str, field: dataclasses.Field, value: Any) -> None:
    """Reject a field of a formulation that is not of its type, or is a negative number."""
    if field.type == "Formulation" and not isinstance(value, Formulation):
        raise InputError(
            f"{where}: got {value!r}, expected a Formulation, not its name: one of the values of "
            "rbjax.constraints.formulations()"
        )
    if field.type == "float" and not isinstance(value, jax.core.Tracer):
        name = where.partition("(")[0]
        if isinstance(value, bool):
            raise InputError(f"{name}: {field.name} is {value!r}, expected a number of at least 0")
        real_number(name, field.name, value, least=0.0)
    if field.type == "int" or (field.type == "int | None" and value is not None):
        integer = isinstance(value, int) and not isinstance(value, bool)
        if not integer or value < 1:
            raise InputError(f"{where}: got {value!r}, expected an integer of at least 1")


@dataclass(frozen=True)
class Multipliers(Formulation):
    """Index 1: G a = -(G' v + ...), with nothing against drift.

    The residual after a time t is g_0 + g'_0 t, and what the integrator adds.
    """

    name: ClassVar[str] = "multipliers"
    family: ClassVar[str] = "redundant"
    index: ClassVar[int] = 1

    def __call__(self, model, t, state, tau, pushes):
        return constrained_motion(model, t, state, tau, pushes)[0]


@dataclass(frozen=True)
class Baumgarte(Formulation):
    """Index 1 with feedback of the residual: g'' + 2 alpha g' + beta^2 g = 0, exactly.

    Fields: alpha, beta in 1/s. alpha = beta is critically damped. Large ones make the equations
    stiff: an explicit step dt needs alpha dt well below 1. (Baumgarte 1972)
    """

    alpha: float = 20.0
    beta: float = 20.0
    name: ClassVar[str] = "baumgarte"
    family: ClassVar[str] = "redundant"
    index: ClassVar[int] = 1

    @classmethod
    def for_step(cls, dt: float) -> Baumgarte:
        """The feedback that is best for steps dt of semi-implicit Euler, with nothing after them:
        alpha = 1 / (2 dt), beta = 0.3 / dt, by which G v+ = -0.09 g / dt. Three steps of ten take
        away two thirds of a residual; each adds about |G' v| dt^2 / 2. Other integrators, with
        stages, want alpha and beta well below 1 / dt.

        Source: Anitescu & Potra 1997 (constraints on the velocity after a step).
        """
        if not (isinstance(dt, int | float) and 0 < dt < math.inf):
            raise InputError(f"Baumgarte.for_step: dt is {dt!r}, expected a positive step, s")
        return cls(0.5 / dt, 0.3 / dt)

    def __call__(self, model, t, state, tau, pushes):
        return constrained_motion(model, t, state, tau, pushes, self.alpha, self.beta)[0]


@dataclass(frozen=True)
class Projected(Formulation):
    """Another formulation, and after each step positions and velocities are put back on the
    constraints by the least change in the norm of the mass matrix.

    Fields: of, the formulation; iterations, of each of the two: by the dtype if None, 2 in f64 and
    1 in f32. Family and index are those of `of`.
    """

    of: Formulation = Multipliers()
    iterations: int | None = None
    name: ClassVar[str] = "projected"

    @property
    def family(self) -> str:  # type: ignore[override]
        return self.of.family

    @property
    def index(self) -> int:  # type: ignore[override]
        return self.of.index

    def __call__(self, model, t, state, tau, pushes):
        return self.of(model, t, state, tau, pushes)

    def settled(self, model: Model, t: Any, state: State) -> State:
        return projected(model, t, self.of.settled(model, t, state), self.iterations)
