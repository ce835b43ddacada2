"""The accelerations and forces at an instant that sensors read, each computed on first use.

    M a + b = tau + sum of J_i^T f_i + G^T l
The dynamics gives a. Forces of constraints and contacts act on bodies; force sensors subtract them
from the rate of momentum of a subtree.
"""

from __future__ import annotations

import dataclasses
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.constraints.reactions import body_reactions
from rbjax.contact.registry import Law
from rbjax.contact.rows.scalar_row import EQUALITY
from rbjax.contact.solver.contact_forces import ContactForces
from rbjax.contact.solver.solution import ContactSolution
from rbjax.forces.context import Context
from rbjax.forces.inputs import Inputs
from rbjax.lanes import Vec3, fusion_barrier
from rbjax.lanes.arrays import unpack
from rbjax.model import State
from rbjax.motion.field import Field, dynamics_of, free_motion, gives_velocities
from rbjax.motion.step import with_memory
from rbjax.sensors.body_forces import wrenches_of_contacts, wrenches_of_tendons
from rbjax.spatial import Force


class MotionSolution:
    """The accelerations of a robot at an instant, and the forces of its constraints and contacts.

    A contact law computes all of them together. If the law computes steps, they belong to the step
    that begins at the instant: the mean acceleration, and the impulses divided by the step. A
    user's dynamics with contacts has a method `contact_forces(model, t, state, tau, f_ext)` that
    returns `ContactForces`; without it no contact force acts.
    """

    def __init__(
        self,
        context: Context,
        inputs: Inputs | None = None,
        dynamics: Any = None,
        *,
        memory: jax.Array | None = None,
        contacts: ContactForces | None = None,
        acceleration: Any = None,
    ):
        self.context = context
        self.inputs = Inputs(context.ctrl) if inputs is None else inputs
        self._dynamics, self._memory = dynamics, memory
        self._contacts, self._acceleration = contacts, acceleration

    @cached_property
    def _field(self) -> Field:
        dynamics, model = self._dynamics, self.context.model
        if dynamics is None:
            dynamics = dynamics_of("acceleration", model, free_motion, None, steps=True)
        return Field(model, dynamics, self.context.dt)

    @cached_property
    def solved(self) -> ContactSolution | None:
        """The solution of the contact problem, or None if the dynamics is not a contact law."""
        law, now = self._field.law, self.context
        if not isinstance(law, Law) or not now.model.nv:
            return None
        tau, f_ext, _ = self._field.applied(now.t, now.state, self.inputs)
        return law.solve(self._field.precomputed, now.t, self._state, tau, f_ext, now.dt)

    @property
    def _state(self) -> State:
        """The state with the memory of the dynamics."""
        return self.context.state.replace(memory=self._memory)

    @cached_property
    def acceleration(self) -> jax.Array:
        """The acceleration v' (nv,)."""
        if self._acceleration is not None:
            return self._acceleration
        if self.solved is not None:
            return self.solved.acceleration
        now = self.context
        if not now.model.nv:
            return jnp.zeros(0, now.q.dtype)
        if gives_velocities(self._field.dynamics):
            state = with_memory(now.model, self._state, self._field.dynamics)
            v, *_ = self._field.advance_velocity(now.t, state, self.inputs, now.h)
            return (v - now.v) / now.h
        a, _ = self._field.rates(now.t, now.state, self.inputs)
        return jnp.stack(fusion_barrier(list(a)))

    @cached_property
    def accelerated(self) -> Context:
        """The context with the acceleration."""
        return self.context.accelerating(self.acceleration)

    @cached_property
    def contacts(self) -> ContactForces | None:
        """The contact forces, or None if the dynamics has no contacts."""
        if self._contacts is not None:
            return self._contacts
        if self.solved is not None:
            return self.solved.contacts
        forces = getattr(self._field.dynamics, "contact_forces", None)
        if forces is None:
            return None
        now = self.context
        tau, f_ext, _ = self._field.applied(now.t, now.state, self.inputs)
        return forces(now.model, now.t, now.state, tau, f_ext)

    @cached_property
    def body_wrenches(self) -> dict[int, Force]:
        """The given wrenches and the forces of constraints, spatial tendons and contacts on bodies,
        by body, in world axes at the body's origin."""
        now, out = self.context, {}
        if self.inputs.wrenches is not None:
            for b, row in enumerate(unpack(self.inputs.wrenches)):
                out[b] = Force(
                    Vec3(*(row[k] for k in range(3))), Vec3(*(row[k] for k in (3, 4, 5)))
                )
        parts = [wrenches_of_tendons(now)]
        if self.contacts is not None:
            parts.append(wrenches_of_contacts(now, self.contacts))
        if now.model.constraints:
            tau, f_ext, _ = self._field.applied(now.t, now.state, self.inputs)
            known = None if self.solved is None else self.solved.forces_of(EQUALITY)
            parts.append(body_reactions(now, tau, f_ext, known))
        for part in parts:
            for b, wrench in part.items():
                out[b] = out[b] + wrench if b in out else wrench
        return out


def solution_of(context: Context) -> MotionSolution:
    """Return the solution of a context, by the default dynamics if it has none yet."""
    if context.solution is not None:
        return context.solution
    return context.once(solution_of, lambda: MotionSolution(context))


def with_solution(
    context: Context, inputs: Inputs, dynamics: Any, memory: jax.Array | None
) -> Context:
    """Return a copy of a context whose sensors read the motion of a dynamics under inputs.

    memory: of the dynamics before the step that begins at the instant; None for its first step.
    """
    solution = MotionSolution(context, inputs, dynamics, memory=memory)
    return dataclasses.replace(context, solution=solution)
