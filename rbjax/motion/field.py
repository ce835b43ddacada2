"""The equations of motion of a robot as a vector field, with a choice of `Dynamics`.

    tau, f_ext, x' = elements(t, q, v, x, ctrl),   v' = dynamics(t, q, v, tau, f_ext),   q' = v
A `Dynamics` maps applied forces to accelerations, `VelocityDynamics` to the velocity after a step.
`step`, `rollout`, `simulate`, `linearise` and GPU threads accept any `Dynamics`, which may define
its own derivative rules. An integrator maps a field and a state to the state after a step.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeGuard, runtime_checkable

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.soft_weights import with_weights
from rbjax.constraints.formulation import Formulation, StageProjection, formulation_of
from rbjax.constraints.rows.soft import is_soft
from rbjax.contact.coulomb import CoulombContact
from rbjax.contact.registry import law_of
from rbjax.contact.soft import SoftContact
from rbjax.dynamics.algorithms import aba
from rbjax.dynamics.algorithms.energy import Entries
from rbjax.dynamics.algorithms.manifold import increment_rate, retract
from rbjax.dynamics.algorithms.rnea import LinkForces, forces_at
from rbjax.dynamics.arguments import check_array, check_model, check_takes
from rbjax.errors import InputError
from rbjax.forces.acting import applied, slopes, stable_slopes, within
from rbjax.forces.element import Element
from rbjax.forces.inputs import Inputs
from rbjax.forces.slopes import Slope
from rbjax.model import Model, State, without_constants
from rbjax.motion.solver_report import reports, with_step


class Dynamics(Protocol):
    """A map from applied forces to accelerations (nv,), for one sample.

    Its arguments are the model, the time, the `State`, generalized forces tau (nv,) and the forces
    f_ext on links, in link axes at the link origins. It must be differentiable in all of them.
    """

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> jax.Array: ...


@runtime_checkable
class VelocityDynamics(Protocol):
    """A map from applied forces to the velocity after a step, with a memory between steps.

    The memory (m,) is `State.memory`: warm starts, multipliers, flags of active contacts. `rollout`
    and `step` pass it on; only the dynamics reads it.
    """

    def initial_memory(self, model: Model) -> jax.Array:
        """Return the memory (m,) before the first step."""
        ...

    def advance_velocity(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces, dt: Any
    ) -> tuple[jax.Array, jax.Array] | tuple[jax.Array, jax.Array, jax.Array]:
        """Compute the velocity (nv,) and the memory (m,) after a step dt. A third result is the
        mean velocity (nv,) over the step, which moves the configuration; without it, the velocity
        after the step does."""
        ...


def free_motion(model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces) -> jax.Array:
    """Compute the unconstrained acceleration v' = M^-1 (tau - b + sum of J_i^T f_i)."""
    return aba.acceleration(model, state.q, state.v, tau, f_ext)


@dataclass(frozen=True)
class Field:
    """The equations of motion of a model under a dynamics.

    model: model without precomputed link constants, so that a user's dynamics or integrator may
        change its leaves (`eqx.tree_at`, `jax.tree.map`).
    dynamics: map from forces to accelerations, or to the velocity after a step.
    dt: step in s that force elements and contacts read; None if no step is fixed.
    precomputed: model with its link constants and inverse weights, for code that does not change
        the leaves.
    """

    model: Model
    dynamics: Any = free_motion
    dt: Any = None
    precomputed: Model = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        soft = isinstance(self.dynamics, SoftContact) or is_soft(self.model)
        object.__setattr__(self, "precomputed", with_weights(self.model) if soft else self.model)
        object.__setattr__(self, "model", without_constants(self.model))

    def rates(self, t: Any, state: State, u: Inputs) -> tuple[jax.Array, jax.Array | None]:
        """Compute the rates v' (nv,) and x' (nx,)."""
        a, x, _ = self.rates_and_error(t, State(state.q, state.v, state.x, state.memory), u)
        return a, x

    def rates_and_error(
        self, t: Any, state: State, u: Inputs
    ) -> tuple[jax.Array, jax.Array | None, jax.Array | None]:
        """Compute the rates v' (nv,) and x' (nx,), and the error of the solver, or None if the
        state has no report or the dynamics no solver."""
        tau, f_ext, x = self.applied(t, state, u)
        a, error = self._acceleration(t, state, tau, f_ext)
        return a, x, error

    def advance_velocity(self, t: Any, state: State, u: Inputs, dt: Any) -> tuple:
        """Compute v (nv,), x (nx,), memory and report after a step dt with constant forces, and the
        velocity (nv,) that moves the configuration."""
        tau, f_ext, x = applied(self.precomputed, t, state, u, dt, advance=True)
        if not isinstance(self.dynamics, VelocityDynamics):
            a, error = self._acceleration(t, state, tau, f_ext)
            v = state.v + dt * a
            return v, x, self.kept(state, error), v
        given = self._model_of_dynamics, t, state, tau, f_ext, dt
        v, memory, *others = self.dynamics.advance_velocity(*given)
        v, kept = self._checked("velocity", v, state), (memory, state.report)
        if state.report is not None and reports(self.dynamics):
            kept = memory, self.report(state, self.dynamics.solver_error(memory))
        if not others:
            return v, x, kept, v
        (mean,) = others
        return v, x, kept, self._checked("mean velocity", mean, state)

    def inertial_force(self, t: Any, state: State, u: Inputs, dt: Any) -> tuple[Any, Any, Any]:
        """Compute M a (nv,) of free motion, x (nx,) after a step dt, memory and report."""
        tau, f_ext, x = self.step_forces(t, state, u, dt)
        return tau - self.bias(state, f_ext), x, self.kept(state, None)

    def step_forces(self, t: Any, state: State, u: Inputs, dt: Any) -> tuple:
        """Compute the generalized forces (nv,), forces on links, and x (nx,) after a step dt."""
        return applied(self.precomputed, t, state, u, dt, advance=True)

    def bias(self, state: State, f_ext: LinkForces) -> jax.Array:
        """Compute the generalized bias forces b - J^T f_ext (nv,) at a state under forces
        on links."""
        return forces_at(self.precomputed, state.q, state.v, jnp.zeros_like(state.v), f_ext)

    def acceleration(self, t: Any, state: State, u: Inputs, dt: Any) -> tuple[Any, Any, Any]:
        """Compute the acceleration (nv,), x (nx,) after a step dt, memory and report."""
        tau, f_ext, x = self.step_forces(t, state, u, dt)
        a, error = self._acceleration(t, state, tau, f_ext)
        return a, x, self.kept(state, error)

    def damped_acceleration(
        self, t: Any, state: State, u: Inputs, dt: Any, damping: Entries
    ) -> tuple[Any, Any, Any]:
        """Compute (M + A)^-1 M a (nv,), x (nx,) after a step dt, memory and report.

        damping: entries of the diagonal matrix A. The dynamics is soft contact.
        """
        tau, f_ext, x = self.step_forces(t, state, u, dt)
        given = self._model_of_dynamics, t, state, tau, f_ext, damping
        a, error = self.law.damped_acceleration(*given)
        return a, x, self.kept(state, error)

    def kept(self, state: State, error: jax.Array | None) -> tuple:
        """Return memory and report of the state after a step. error: the error of the contact
        solver."""
        return state.memory, self.report(state, error)

    def report(self, state: State, error: jax.Array | None) -> jax.Array | None:
        """Return the report of a state after a step. error: the error of the contact solver."""
        if state.report is None or error is None:
            return state.report
        return with_step(state.report, error, self.dynamics.solver_tolerance(error.dtype))

    def applied(self, t: Any, state: State, u: Inputs) -> tuple:
        """Compute the applied generalized forces (nv,), forces on links, and x' (nx,)."""
        return applied(self.precomputed, t, state, u, self.dt)

    def _acceleration(
        self, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> tuple[jax.Array, jax.Array | None]:
        """Compute the acceleration (nv,) and the error of the solver (`rates_and_error`)."""
        law, error = self.law, None
        given = self._model_of_dynamics, t, state, tau, f_ext
        if state.report is not None and reports(law):
            a, error = law.acceleration_and_error(*given)
        else:
            a = law(*given)
        return a if self.dynamics is free_motion else self._checked("result", a, state), error

    def _checked(self, what: str, x: Any, state: State) -> jax.Array:
        x = check_array("dynamics", f"the {what} of the dynamics", x, (self.model.nv,))
        return x.astype(state.q.dtype)

    @property
    def law(self) -> Any:
        """The dynamics. A law of soft contact without a step gets the step of the field."""
        dynamics = self.dynamics
        if isinstance(dynamics, SoftContact) and dynamics.dt is None:
            return replace(dynamics, dt=self.dt)
        return dynamics

    @property
    def _model_of_dynamics(self) -> Model:
        laws = Formulation | SoftContact | CoulombContact
        own = self.dynamics is free_motion or isinstance(self.dynamics, laws)
        return self.precomputed if own else self.model

    def forces(
        self, t: Any, state: State, u: Inputs
    ) -> tuple[jax.Array, LinkForces, jax.Array | None, jax.Array | None]:
        """Compute all generalized forces (nv,), forces on links, x' (nx,), and the error of the
        solver (`rates_and_error`). If the dynamics is not free motion, tau is its inverse dynamics
        and includes the constraint forces."""
        tau, f_ext, x = self.applied(t, state, u)
        error = None
        if self.dynamics is not free_motion:
            a, error = self._acceleration(t, state, tau, f_ext)
            tau = forces_at(self.precomputed, state.q, state.v, a, f_ext)
        return tau, f_ext, x, error

    def retract(self, q: jax.Array, dq: jax.Array) -> jax.Array:
        """Return the configuration q (+) dq."""
        return retract(self.precomputed, q, dq)

    def slopes(
        self, t: Any, state: State, u: Inputs, dt: Any, of: type[Element] = Element
    ) -> list[Slope]:
        """List the stiffness and damping of the forces, or of the elements of a class."""
        return slopes(self.precomputed, t, state, u.ctrl, dt, of=of)

    def stable_slopes(
        self, t: Any, state: State, u: Inputs, dt: Any
    ) -> tuple[list[Slope], list[Slope]]:
        """List the stiffness and damping of the forces, none below zero."""
        return stable_slopes(self.precomputed, t, state, u.ctrl, dt)

    def stage_state(self, t: Any, state: State, t0: Any, start: State) -> State:
        """Return the state for the rates of a stage, in a step that begins at (t0, start)."""
        if not moves_stages(self.dynamics):
            return state
        return self.dynamics.stage_state(self.precomputed, t, state, t0, start)

    def project(self, t: Any, state: State) -> State:
        """Project the state after a step onto the constraints, if the dynamics is a formulation
        with a projection."""
        if not isinstance(self.dynamics, Formulation):
            return state
        return self.dynamics.project(self.precomputed, t, state)

    def within(self, x: jax.Array | None) -> jax.Array | None:
        """Clip the states (nx,) of force elements to their ranges."""
        return within(self.precomputed, x)

    def increment_rate(self, u: jax.Array, v: jax.Array) -> jax.Array:
        """Compute the rate of an increment u at velocity v: J_r(u)^-1 v for free and ball joints,
        v for other dofs."""
        return increment_rate(self.precomputed, u, v)


def moves_stages(dynamics: Any) -> TypeGuard[Formulation]:
    """Check whether a dynamics projects the state of a stage before its rates are evaluated."""
    return isinstance(dynamics, Formulation) and isinstance(dynamics.projection, StageProjection)


def gives_velocities(dynamics: Any) -> TypeGuard[VelocityDynamics]:
    """Check whether a dynamics gives the velocity after a step, and no accelerations."""
    return isinstance(dynamics, VelocityDynamics) and not callable(dynamics)


def with_contact(where: str, model: Model, dynamics: Any, contact: Any) -> Any:
    """Return the dynamics of a contact law, or the given dynamics if there is no law.

    Raises:
        InputError: no such law, a law that does not suit the model, or a law and a dynamics.
    """
    if contact is None:
        return dynamics
    check_model(where, model)
    if dynamics is not free_motion:
        raise InputError(f"{where}: got dynamics and contact={contact!r}, expected one of them")
    return law_of(where, model, contact)


def dynamics_of(
    where: str, model: Model, dynamics: Any, constraints: Any, *, steps: bool = False
) -> Any:
    """Return the dynamics of a motion: the given one, the contact law of the model, a formulation
    of its constraints, or free motion.

    steps: whether the motion has fixed steps, which `VelocityDynamics` require.

    Raises:
        InputError: neither a dynamics nor a formulation, or both.
    """
    check_model(where, model)
    if dynamics is free_motion:
        law = model.contact
        if law is not None and constraints is not None:
            raise InputError(
                f"{where}: got constraints={constraints!r} and a model with contact={law!r}, whose "
                "law solves contacts and soft constraints together; leave constraints out, or "
                "leave contacts out by model.replace(contact=None)"
            )
        if law is None:
            return formulation_of(where, model, constraints) or dynamics
        dynamics = law_of(where, model, law)
    if gives_velocities(dynamics):
        if not steps:
            raise InputError(
                f"{where}: {type(dynamics).__name__} maps forces to the velocity after a step, and "
                "here no step is fixed; give a dynamics that maps forces to accelerations, or use "
                "step or rollout"
            )
    else:
        check_takes(where, "dynamics", dynamics, "model", "t", "state", "tau", "f_ext")
    if constraints is not None:
        raise InputError(
            f"{where}: got dynamics and constraints={constraints!r}; give one of them: a "
            "formulation is a dynamics"
        )
    return dynamics
