"""The motion of a robot as a field: its forces, and the law by which they accelerate it.

    tau, w, x' = elements(t, q, v, x, u),      v' = law(t, q, v, tau, w),      q' = v
A law stands between "the forces are known" and "the acceleration is known": free motion is one, a
constraint that holds is another. It is a function with its own derivative rules; `simulate`,
`rollout`, `linearise` and GPU threads all take it. An integrator stands one step further out: from
a field and a state to the state after a step.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeGuard

import jax

from rbjax.constraints.formulation import Formulation, TangentSpace
from rbjax.constraints.registry import formulation_of
from rbjax.dynamics.algorithms.forward import acceleration
from rbjax.dynamics.algorithms.link_forces import LinkForces
from rbjax.dynamics.algorithms.manifold import increment_rate, retract
from rbjax.dynamics.algorithms.rnea import forces_of
from rbjax.dynamics.arguments import check_array, check_model, check_takes
from rbjax.errors import InputError
from rbjax.forces.acting import applied, chord, within
from rbjax.forces.inputs import Inputs
from rbjax.model import Model, State, without_constants


class Law(Protocol):
    """From forces to accelerations (nv,), of one sample.

    state: `State`; tau: (nv,) generalized forces; pushes: forces on links, in their axes at their
    origins. It must be differentiable in all of them, and in the model.
    """

    def __call__(
        self, model: Model, t: Any, state: State, tau: jax.Array, pushes: LinkForces
    ) -> jax.Array: ...


def free_motion(
    model: Model, t: Any, state: State, tau: jax.Array, pushes: LinkForces
) -> jax.Array:
    """v' = M^-1 (tau - b + sum of J_i^T f_i)."""
    return acceleration(model, state.q, state.v, tau, pushes)


@dataclass(frozen=True)
class Field:
    """The motion of a model under a law. dt: the step that force elements read; None if no step is
    fixed.

    `model` has no precomputed link constants, so a user's law or integrator that changes its leaves
    (`eqx.tree_at`, `jax.tree.map`) changes the motion. `precomputed` is the same model with its
    precomputed constants, for code that does not change the leaves.
    """

    model: Model
    law: Law = free_motion
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
        tau, pushes, x = forces(t, state, u)
        return self._accelerated(t, state, tau, pushes), x

    def _accelerated(self, t: Any, state: State, tau: jax.Array, pushes: LinkForces) -> jax.Array:
        """v' by the law."""
        a = self.law(self._of_law, t, state, tau, pushes)
        if self.law is free_motion:
            return a
        what = "what the law returned"
        return check_array("a law", what, a, (self.model.nv,)).astype(state.q.dtype)

    @property
    def _of_law(self) -> Model:
        """The model that is passed to the law."""
        own = self.law is free_motion or isinstance(self.law, Formulation)
        return self.precomputed if own else self.model

    def forces(
        self, t: Any, state: State, u: Inputs
    ) -> tuple[jax.Array, LinkForces, jax.Array | None]:
        """Generalized forces (nv, ...), forces on links, and x' (nx, ...). Those of a law other
        than free motion are what gives its acceleration: with the forces of a constraint."""

        tau, pushes, x = self.applied(t, state, u)
        if self.law is not free_motion:
            a = self._accelerated(t, state, tau, pushes)
            tau = forces_of(self.precomputed, state.q, state.v, a, pushes)
        return tau, pushes, x

    def retract(self, q: jax.Array, dq: jax.Array) -> jax.Array:
        """q (+) dq."""
        return retract(self.precomputed, q, dq)

    def chord(self, t: Any, state: State, u: Inputs, dt: Any) -> dict:
        """What forces at the middle of a step add to the diagonal of the mass matrix, lanes (...)
        by velocity coordinate."""

        return chord(self.precomputed, t, state, u.ctrl, dt)

    def staged(self, t: Any, state: State, t0: Any, start: State) -> State:
        """The state at which a stage's rates are taken, of a step that began at t0 in `start`."""
        if not moves_stages(self.law):
            return state
        return self.law.stage_state(self.precomputed, t, state, t0, start)

    def settled(self, t: Any, state: State) -> State:
        """The state after a step, as the law leaves it: a formulation may put it back on its
        constraints."""
        if not isinstance(self.law, Formulation):
            return state
        return self.law.project(self.precomputed, t, state)

    def within(self, x: jax.Array | None) -> jax.Array | None:
        """The states (nx, ...) of force elements, clipped to their ranges."""
        return within(self.precomputed, x)

    def increment_rate(self, u: jax.Array, v: jax.Array) -> jax.Array:
        """u' of the increment u of a configuration that moves at v."""
        return increment_rate(self.precomputed, u, v)


def moves_stages(law: Law) -> TypeGuard[Formulation]:
    """Whether a law takes the rates of a stage at another state."""
    return isinstance(law, Formulation) and isinstance(law.projection, TangentSpace)


def law_of(where: str, model: Model, law: Any, constraints: Any) -> Law:
    """The law of a motion: the caller's, or that which enforces the model's constraints, or free
    motion. Refuses what is no law, no formulation, and both at once."""
    check_model(where, model)
    if law is free_motion:
        return formulation_of(where, model, constraints) or law
    check_takes(where, "law", law, "model", "t", "state", "tau", "pushes")
    if constraints is not None:
        raise InputError(
            f"{where}: got a law and constraints={constraints!r}; give one of them: a formulation "
            "is a law"
        )
    return law
