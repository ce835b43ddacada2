"""A feedback controller: from time and state to the forces and controls of the actuators.

    tau_a = tau(t, x),      u = B^+ (tau_a - b)             (`actuation.py`)
tau_a are the forces of the actuators, in addition to springs, dampers, friction, wind and all other
forces on the model, so `rollout(model, state, law, ...)` through the actuators and
`rollout(model, state, tau=law.tau, ...)` without them are the same motion, where no limit is met
and every coordinate is driven.
"""

from __future__ import annotations

import abc
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.control.laws.allocation import Allocation, allocate, check_driven
from rbjax.dynamics.algorithms.rnea import inverse_dynamics
from rbjax.dynamics.arguments import check_array, check_model, check_moves
from rbjax.errors import InputError
from rbjax.forces import applied_forces
from rbjax.model import Model, State
from rbjax.model.record import Record


class Controller(Record):
    """A policy (t, state) -> ctrl of a model. Its gains and the model are leaves.

    controller(t, state): controls (nu,), within their ranges.
    controller.tau(t, state): the desired generalized forces (nv,) of the actuators.
    controller.allocated(t, state): the controls, and the forces that the actuators cannot give.
    """

    model: Model
    undriven: str = eqx.field(static=True)

    def __hash__(self) -> int:
        return id(self)  # `jax.jit(law)` knows functions by their identity

    @abc.abstractmethod
    def tau(self, t: Any, state: State) -> jax.Array:
        """(nv,) N m or N, the generalized forces that the actuators shall give."""

    def __call__(self, t: Any, state: State) -> jax.Array:
        """(nu,) controls, within their ranges."""
        return self.allocated(t, state).ctrl

    def allocated(self, t: Any, state: State) -> Allocation:
        """The controls, and the residual forces (nv,) that the actuators cannot give."""
        return allocate(self.model, state, self.tau(t, state))


def check_controlled_model(where: str, model: Any, undriven: str, actuated: bool = True) -> None:
    """Check the model of a controller."""
    check_model(where, model)
    check_moves(where, model)
    if model.constraints:
        raise InputError(
            f"{where}: the model has {len(model.constraints)} constraints, whose forces this law "
            "does not know; expected a tree: model.replace(constraints=())"
        )
    if model.nu:
        check_driven(where, model, undriven)


def gains(where: str, name: str, value: Any, n: int, *, least: float = 0.0) -> jax.Array:
    """A gain for each of n coordinates, from a number or (n,), none below `least`."""
    x = check_array(where, name, value, (), (n,))
    if not isinstance(x, jax.core.Tracer) and (np.asarray(x) < least).any():
        raise InputError(f"{where}: {name} is {value}, expected numbers of at least {least}")
    return jnp.broadcast_to(x, (n,))


def actuator_forces(model: Model, state: State, a: jax.Array) -> jax.Array:
    """The actuator forces (nv,) for the accelerations a: M a + b - the other forces."""
    return inverse_dynamics(model, state.q, state.v, a) - applied_forces(model, state, None)


def holding_forces(model: Model, state: State) -> jax.Array:
    """The actuator forces (nv,) that hold the robot at rest in this configuration."""
    still = State(state.q, jnp.zeros_like(state.v), state.x)
    return actuator_forces(model, still, still.v)
