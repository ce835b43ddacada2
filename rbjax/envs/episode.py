"""The pytrees of an environment: its parameters, and the state of an episode."""

from __future__ import annotations

from typing import Any

import jax

from rbjax.model import Model, State
from rbjax.model.record import Record


class Params(Record):
    """The parameters of an environment, an argument of `reset` and `step`.

    Use it to change numbers without compiling again, to map over robots (`jax.vmap`), and to
    differentiate with respect to them.

    model: the robot, before the randomisation of an episode.
    weights: name of a reward term -> its factor ().
    noise: () factor of the noise of observations; 0 for none.
    values: name -> number or array of the task: ranges of commands, strengths of pushes.

    Example:
        >>> import rbjax as rb
        >>> params = rb.envs.make("cart_pole_balance").default_params
        >>> float(params.replace(noise=0.0).noise)
        0.0
    """

    model: Model
    weights: dict[str, jax.Array]
    noise: jax.Array
    values: dict[str, jax.Array]


class EnvState(Record):
    """The state of an episode.

    state: state of motion.
    acceleration: (nv,) mean acceleration over the last physics step, read by accelerometers.
    step: control steps since the reset, int32.
    action: (na,) last action of the policy.
    ctrl: (nu,) last controls.
    variables: name -> variable of the task.
    drawn: name -> value of a randomisation.
    delays: "GROUP/NAME" of a delayed observation, or "action" -> delay in control steps, int32.
    buffers: "GROUP/NAME" of a delayed observation, or "action" -> its last values, newest first.
    episode_return: sum of the rewards since the reset.
    """

    state: State
    acceleration: jax.Array
    step: jax.Array
    action: jax.Array
    ctrl: jax.Array
    variables: dict[str, Any]
    drawn: dict[str, Any]
    delays: dict[str, jax.Array]
    buffers: dict[str, jax.Array]
    episode_return: jax.Array
