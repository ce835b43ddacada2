"""The sensor protocol: a sensor reads a context and gives an array with names and a unit."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp

from rbjax.forces.inputs import Inputs
from rbjax.lanes import fusion_barrier
from rbjax.model import Model, State
from rbjax.motion.field import Field, dynamics_of, free_motion
from rbjax.sensors.columns import Columns


@dataclass(frozen=True)
class Context:
    """An instant of a motion.

    Fields:
        t: seconds after the start.
        state: q, v and the states of force elements.
        ctrl: (nu,) the controls that act.
        model: the robot.
        step: the time step in s, which force elements see; None if there is none.
    """

    t: Any
    state: State
    ctrl: jax.Array
    model: Model
    step: float | None = None

    @property
    def acceleration(self) -> jax.Array:
        """v' (nv,), by the dynamics."""
        dynamics = dynamics_of("Context", self.model, free_motion, None)
        field = Field(self.model, dynamics, self.step)
        rates = field.rates(self.t, self.state, Inputs(self.ctrl))[0]
        return jnp.stack(fusion_barrier(list(rates)))


@runtime_checkable
class Sensor(Protocol):
    """An ideal sensor. A user's own sensor has these methods; `names` may be left out."""

    def __call__(self, context: Context) -> jax.Array:
        """The measured values (n,), traced."""
        ...

    def columns(self, model: Model) -> Columns:
        """How many values there are, and which are quaternions."""
        ...

    def unit(self, model: Model) -> str:
        """The SI unit, for messages."""
        ...
