"""The motion of a robot as a field: its forces, and the dynamics from forces to accelerations.

    tau, w, x' = elements(t, q, v, x, u),      v' = dynamics(t, q, v, tau, w),      q' = v
A `Dynamics` maps applied forces to accelerations. Free motion is one, motion under constraints is
another. It is a function with its own derivative rules; `simulate`, `rollout`, `linearise` and GPU
threads take it. An integrator maps a field and a state to the state after a step.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeGuard

import jax

from rbjax.constraints.formulation import Formulation, StageProjection, formulation_of
from rbjax.dynamics.algorithms.forward import acceleration
from rbjax.dynamics.algorithms.link_forces import LinkForces
from rbjax.dynamics.algorithms.manifold import increment_rate, retract
from rbjax.dynamics.algorithms.rnea import forces_of
from rbjax.dynamics.arguments import check_array, check_model, check_takes
from rbjax.errors import InputError
from rbjax.forces.acting import applied, implicit_stiffness, within
from rbjax.forces.inputs import Inputs
from rbjax.model import Model, State, without_constants


class Dynamics(Protocol):
    """From forces to accelerations (nv,), of one sample.

    state: `State`; tau: (nv,) generalized forces; f_ext: forces on links, in their axes at their
    origins. It must be differentiable in all of them, and in the model.
    """

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces
    ) -> jax.Array: ...


def free_motion(model: Model, t: Any, state: State, tau: jax.Array, f_ext: LinkForces) -> jax.Array:
    """v' = M^-1 (tau - b + sum of J_i^T f_i)."""
    return acceleration(model, state.q, state.v, tau, f_ext)


@dataclass(frozen=True)
class Field:
    """The motion of a model under a dynamics. dt: the step that force elements read; None if no
    step is fixed.

    `model` has no precomputed link constants, so a user's dynamics or integrator that changes its
    leaves (`eqx.tree_at`, `jax.tree.map`) changes the motion. `precomputed` is the same model with
    its precomputed constants, for code that does not change the leaves.
    """

    model: Model
    dynamics: Dynamics = free_motion
    dt: Any = None
    precomputed: Model = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "precomputed", self.model)
        object.__setattr__(self, "model", without_constants(self.model))

    def rates(self, t: Any, state: State, u: Inputs) -> tuple[jax.Array, jax.Array | None]:
        """v' (nv, ...) and x' (nx, ...)."""
        return self._found(self.applied, t, state, u)

    def pushed(
        self, t: Any, state: State, u: Inputs, dt: Any
    ) -> tuple[jax.Array, jax.Array | None]:
        """v' (nv, ...), and x after a step in which its rate is held."""
        advance = functools.partial(applied, self.precomputed, dt=dt, advance=True)
        return self._found(advance, t, state, u)

    def applied(self, t: Any, state: State, u: Inputs) -> tuple:
        """Generalized forces, forces on links, and x' of one sample."""
        return applied(self.precomputed, t, state, u, self.dt)

    def _found(self, forces: Callable, t: Any, state: State, u: Inputs) -> tuple:
        tau, f_ext, x = forces(t, state, u)
        return self._accelerated(t, state, tau, f_ext), x

    def _accelerated(self, t: Any, state: State, tau: jax.Array, f_ext: LinkForces) -> jax.Array:
        """v' by the dynamics."""
        a = self.dynamics(self._of_law, t, state, tau, f_ext)
        if self.dynamics is free_motion:
            return a
        what = "the result of the dynamics"
        return check_array("dynamics", what, a, (self.model.nv,)).astype(state.q.dtype)

    @property
    def _of_law(self) -> Model:
        """The model that is passed to the dynamics."""
        own = self.dynamics is free_motion or isinstance(self.dynamics, Formulation)
        return self.precomputed if own else self.model

    def forces(
        self, t: Any, state: State, u: Inputs
    ) -> tuple[jax.Array, LinkForces, jax.Array | None]:
        """Generalized forces (nv, ...), forces on links, and x' (nx, ...). Unless the dynamics
        is free motion, they are the inverse dynamics of its acceleration: with constraint
        forces."""

        tau, f_ext, x = self.applied(t, state, u)
        if self.dynamics is not free_motion:
            a = self._accelerated(t, state, tau, f_ext)
            tau = forces_of(self.precomputed, state.q, state.v, a, f_ext)
        return tau, f_ext, x

    def retract(self, q: jax.Array, dq: jax.Array) -> jax.Array:
        """q (+) dq."""
        return retract(self.precomputed, q, dq)

    def implicit_stiffness(self, t: Any, state: State, u: Inputs, dt: Any) -> dict:
        """The implicit stiffness of forces at the middle of a step: what they add to the diagonal
        of the mass matrix, lanes (...) by velocity coordinate."""

        return implicit_stiffness(self.precomputed, t, state, u.ctrl, dt)

    def stage_state(self, t: Any, state: State, t0: Any, start: State) -> State:
        """The state at which a stage's rates are evaluated, of a step that began at t0 in
        `start`."""
        if not moves_stages(self.dynamics):
            return state
        return self.dynamics.stage_state(self.precomputed, t, state, t0, start)

    def project(self, t: Any, state: State) -> State:
        """The state after a step, projected onto the constraints if the dynamics is a formulation
        that projects."""
        if not isinstance(self.dynamics, Formulation):
            return state
        return self.dynamics.project(self.precomputed, t, state)

    def within(self, x: jax.Array | None) -> jax.Array | None:
        """The states (nx, ...) of force elements, clipped to their ranges."""
        return within(self.precomputed, x)

    def increment_rate(self, u: jax.Array, v: jax.Array) -> jax.Array:
        """u' of the increment u of a configuration that moves at v."""
        return increment_rate(self.precomputed, u, v)


def moves_stages(dynamics: Dynamics) -> TypeGuard[Formulation]:
    """Whether a dynamics takes the rates of a stage at another state."""
    return isinstance(dynamics, Formulation) and isinstance(dynamics.projection, StageProjection)


def dynamics_of(where: str, model: Model, dynamics: Any, constraints: Any) -> Dynamics:
    """The dynamics of a motion: the caller's, a formulation that enforces the model's constraints,
    or free motion. Raises if it is neither a dynamics nor a formulation, or if both are given."""
    check_model(where, model)
    if dynamics is free_motion:
        return formulation_of(where, model, constraints) or dynamics
    check_takes(where, "dynamics", dynamics, "model", "t", "state", "tau", "f_ext")
    if constraints is not None:
        raise InputError(
            f"{where}: got dynamics and constraints={constraints!r}; give one of them: a "
            "formulation is a dynamics"
        )
    return dynamics
