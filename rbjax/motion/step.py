"""`acceleration` and `step`: the acceleration at a state and the state after one step, with all
forces on the model."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.compiling import inside_jit
from rbjax.constraints.formulation import Formulation
from rbjax.contact.coulomb import CoulombContact
from rbjax.contact.impact_bias import warn_of_impacts
from rbjax.contact.soft import SoftContact
from rbjax.dynamics.algorithms.aba import saves_factors
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.dynamics.tracing.custom_rules import is_traced
from rbjax.forces.inputs import Inputs, Source, inputs_at
from rbjax.lanes import fusion_barrier
from rbjax.model import Model, State
from rbjax.motion.field import (
    Dynamics,
    Field,
    VelocityDynamics,
    dynamics_of,
    free_motion,
    with_contact,
)
from rbjax.motion.integrators import Integrator, advance_state, integrator_of
from rbjax.motion.solver_report import warn_if_unconverged

#: the end of the warning of derivatives through impacts
ONE_STEP = ", or take rb.linearise if the motion is one step"


def acceleration(
    model: Model,
    state: State,
    ctrl: ArrayLike | Source | None = None,
    *,
    tau: ArrayLike | Source | None = None,
    wrenches: ArrayLike | Source | None = None,
    t: Any = 0.0,
    dynamics: Dynamics = free_motion,
    constraints: str | Formulation | None = None,
    contact: Any = None,
) -> jax.Array:
    """Compute the acceleration v' (nv,) of the whole model: actuators, springs and dampers, force
    elements and constraints.

    v' = M^-1 (tau(q, v, x, ctrl) + tau_given + J^T w - b), or the constrained acceleration if the
    model has constraints. `forward_dynamics` has only the bodies and the given forces.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))`, with x (nx,) if force elements have states.
        ctrl: controls (nu,); None for no actuation.
        tau: generalized forces (nv,) in addition to those of the model.
        wrenches: (nb, 6) [moment N m; force N] on bodies, in world axes at their origins. Each of
            ctrl, tau and wrenches may be a function (t, state).
        t: time in s, for force elements that depend on it.
        dynamics: map from forces to accelerations (`rbjax.motion.field.Dynamics`).
        constraints: how to enforce the constraints of the model: a name of
            `rbjax.constraints.formulations`, a `Formulation`, or None for "projected".
        contact: law of contact between the geoms of the model, a name of `rbjax.contact.laws`; None
            for the law of the model (`load(contacts=True)`).

    Returns:
        (nv,) in the units of v per second.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 7, 8.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> rb.acceleration(model, model.default_state(), jnp.ones(1)).shape
        (2,)
    """
    given = inputs_at("acceleration", model, Inputs(ctrl, tau, wrenches), t, state)
    return _acceleration(
        model, state, *given, t=t, dynamics=dynamics, constraints=constraints, contact=contact
    )


@algorithm(
    "state", "ctrl", "tau", "wrenches", "t", where="acceleration", long=True, saves=saves_factors
)
def _acceleration(
    model: Model, state: State, ctrl: Any = None, tau: Any = None, wrenches: Any = None,
    *, t: Any = 0.0, dynamics: Any = free_motion, constraints: Any = None, contact: Any = None,
) -> jax.Array:  # fmt: skip
    if not model.nv:
        return jnp.zeros(0, state.q.dtype)
    dynamics = with_contact("acceleration", model, dynamics, contact)
    dynamics = dynamics_of("acceleration", model, dynamics, constraints)
    a, _ = Field(model, dynamics).rates(t, state, Inputs(ctrl, tau, wrenches))
    return jnp.stack(fusion_barrier(list(a)))


def step(
    model: Model,
    state: State,
    ctrl: ArrayLike | Source | None = None,
    dt: Any = None,
    *,
    tau: ArrayLike | Source | None = None,
    wrenches: ArrayLike | Source | None = None,
    t: Any = 0.0,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics | VelocityDynamics = free_motion,
    constraints: str | Formulation | None = None,
    contact: Any = None,
) -> State:
    """Advance a state by one step of `rollout`, with constant inputs over the step.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))`, with x (nx,) if force elements have states, and the memory
            of the dynamics if it has one (None: its initial memory).
        ctrl: controls (nu,); None for no actuation.
        dt: step in s; the model's timestep if None.
        tau: generalized forces (nv,) in addition to those of the model.
        wrenches: (nb, 6) [moment N m; force N] on bodies, in world axes at their origins. Each of
            ctrl, tau and wrenches may be a function (t, state).
        t: time in s, for force elements that depend on it.
        integrator: as in `rollout`.
        dynamics: map from forces to accelerations, or to the velocity after the step
            (`rbjax.motion.field.Dynamics`, `VelocityDynamics`).
        constraints: how to enforce the constraints of the model: a name of
            `rbjax.constraints.formulations`, a `Formulation`, or None for "projected".
        contact: law of contact between the geoms of the model, a name of `rbjax.contact.laws`; None
            for the law of the model (`load(contacts=True)`).

    Returns:
        `State` after the step. Its `report` is the given report and this step, or None if none was
        given. Outside traced code a step whose solver of contacts does not converge warns.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, an unknown integrator, a
            step that is not positive.

    Source: see `rollout`.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> rb.step(model, model.default_state(), dt=0.01).q.shape
        (2,)
    """
    given = inputs_at("step", model, Inputs(ctrl, tau, wrenches), t, state)

    def law() -> Any:
        found = with_contact("step", model, dynamics, contact)
        return dynamics_of("step", model, found, None, steps=True)

    contacts = contact is not None or dynamics is not free_motion or getattr(model, "contact", None)
    watched = contacts and not inside_jit() and isinstance(state, State) and state.report is None
    if contacts and isinstance(state, State) and is_traced((state.q, state.v)):
        q, v = warn_of_impacts("step", model, law(), state.q, state.v, advice=ONE_STEP)
        state = state.replace(q=q, v=v)
    if watched:
        report: Any = np.zeros(2)  # a compiled function accepts it faster than a JAX array
        state = State(state.q, state.v, state.x, state.memory, report)
    after = _step(
        model, state, given.ctrl, dt, given.tau, given.wrenches, t=t, integrator=integrator,
        dynamics=dynamics, constraints=constraints, contact=contact,
    )  # fmt: skip
    if not watched:
        return after
    warn_if_unconverged("step", after, law())
    return State(after.q, after.v, after.x, after.memory)


def _solves(model: Model, *args: Any, contact: Any, dynamics: Any, **others: Any) -> bool:
    """Check whether a step solves a contact problem."""
    own = model.contact if dynamics is free_motion else None
    return (contact or own) is not None or isinstance(dynamics, SoftContact | CoulombContact)


@algorithm("state", "ctrl", "dt", "tau", "wrenches", "t", where="step", long=True, saves=_solves)
def _step(
    model: Model, state: State, ctrl: Any = None, dt: Any = None, tau: Any = None,
    wrenches: Any = None, *, t: Any = 0.0, integrator: Any = None, dynamics: Any = free_motion,
    constraints: Any = None, contact: Any = None,
) -> State:  # fmt: skip
    dt = jnp.asarray(model.timestep, state.q.dtype) if dt is None else dt
    dynamics = with_contact("step", model, dynamics, contact)
    dynamics = dynamics_of("step", model, dynamics, constraints, steps=True)
    integrator = integrator_of("step", integrator, dynamics, model)
    state, inputs = with_memory(model, state, dynamics), Inputs(ctrl, tau, wrenches)
    return advance_state(integrator, Field(model, dynamics, dt), t, state, inputs, dt)


def with_memory(model: Model, state: State, dynamics: Any, batch: tuple[int, ...] = ()) -> State:
    """Fill the memory of a state with the initial memory of the dynamics, unless it has one."""
    if not isinstance(dynamics, VelocityDynamics):
        return State(state.q, state.v, state.x, None, state.report)
    if state.memory is not None:
        return state
    memory = jnp.asarray(dynamics.initial_memory(model), state.q.dtype)
    return state.replace(memory=jnp.broadcast_to(memory, (*batch, *memory.shape)))
