"""`Transition`: the argument of all terms of a task."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import jax

from rbjax.display import displayed
from rbjax.envs.episode import Params
from rbjax.forces.context import Context
from rbjax.model import Model, State


@displayed
@dataclass(frozen=True)
class Transition:
    """A control step: the state before it, the state after it, and the action.

    The argument of observation terms, reward terms, terminations and variables. Observations after
    a reset read a transition whose states are the initial state, with a zero action.

    before: state of motion before the control step.
    after: context of the state after it: `after.q`, `after.v`, `after.body("trunk")`,
        `after.site("imu")`. Sensors are functions of a context.
    action: (na,) action of the policy in this step.
    last_action: (na,) action of the step before.
    ctrl: (nu,) controls in this step.
    last_ctrl: (nu,) controls of the step before.
    variables: name -> variable of the task.
    params: parameters of the environment.
    dt: control step in s.
    step: control steps since the reset, this one included.
    terminated: whether a termination of the task is true; False for observations and for the
        terminations themselves.
    """

    before: State
    after: Context
    action: jax.Array
    last_action: jax.Array
    ctrl: jax.Array
    last_ctrl: jax.Array
    variables: dict[str, Any]
    params: Params
    dt: Any
    step: Any
    terminated: Any = False

    @property
    def model(self) -> Model:
        """The model, with what was drawn for the episode."""
        return self.after.model
