"""gymnax: environments for learners that are written in JAX, such as those of rejax.

The interface of gymnax 1.0 returns (obs, state, reward, terminated, truncated, info) from a step.
rejax 0.1 expects (obs, state, reward, done, info), as older versions of gymnax have it.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance
from rbjax.envs.adapters.arguments import check_environment
from rbjax.envs.adapters.gymnasium import finite
from rbjax.envs.environment import Environment
from rbjax.envs.episode import EnvState, Params
from rbjax.model.record import Record
from rbjax.optional import require


class GymnaxParams(Record):
    """Parameters of a gymnax environment.

    params: `Params` of the environment.
    max_steps_in_episode: control steps after which an episode is truncated; at most those of the
        task. The steps of `to_rejax` do not read it: their episodes have those of the task.

    Example:
        >>> import rbjax as rb
        >>> env = rb.envs.adapters.to_gymnax(rb.envs.make("cart_pole_balance"))
        >>> int(env.default_params.replace(max_steps_in_episode=50).max_steps_in_episode)
        50
    """

    params: Params
    max_steps_in_episode: Any


def to_gymnax(environment: Environment, params: Params | None = None) -> Any:
    """Return an environment with the interface of gymnax 1.0.

    Args:
        environment: an `rb.envs.Environment`.
        params: parameters in `default_params`; None for `environment.default_params`.
            `Task.curriculum` is not applied.

    Returns:
        A `gymnax.environments.environment.Environment`. Its state is an `EnvState`, its parameters
        are `GymnaxParams`. Gradients through a step are stopped, as gymnax does, but for
        `env.with_transition_gradients()`.

    Raises:
        InputError: gymnax is not installed, or not an environment.

    Source: Lange, *gymnax*, 2022; version 1.0.

    Example:
        >>> import jax, jax.numpy as jnp, rbjax as rb
        >>> env = rb.envs.adapters.to_gymnax(rb.envs.make("cart_pole_balance"))
        >>> obs, state = env.reset(jax.random.key(0), env.default_params)
        >>> obs, state, reward, terminated, truncated, info = env.step(
        ...     jax.random.key(1), state, jnp.zeros(1), env.default_params)
        >>> obs.shape
        (5,)
    """
    require("to_gymnax", "gymnax")
    check_environment("to_gymnax", environment, params)
    return _classes()[0](environment, params)


def to_rejax(environment: Environment, params: Params | None = None) -> Any:
    """Return an environment for the algorithms of rejax 0.1.

    Use it as `rejax.get_algo("ppo").create(env=to_rejax(env), ...)`. A step of a batch is one
    kernel, or three if the robot has contacts. The group "policy" is the observation. An episode
    is truncated after `environment.episode` steps, whatever `max_steps_in_episode` is; rejax
    limits its own evaluations by it. rejax knows one flag, done = terminated | truncated: its
    value functions do not bootstrap at truncations.

    Args:
        environment: an `rb.envs.Environment`.
        params: parameters in `default_params`; None for `environment.default_params`.
            `Task.curriculum` is not applied.

    Returns:
        As `to_gymnax`, but a step returns (obs, state, reward, done, info).

    Raises:
        InputError: gymnax is not installed, or not an environment.

    Source: Liesen et al., *rejax*, 2024; version 0.1.3.

    Example:
        >>> import jax, jax.numpy as jnp, rbjax as rb
        >>> env = rb.envs.adapters.to_rejax(rb.envs.make("cart_pole_balance"))
        >>> obs, state = env.reset(jax.random.key(0), env.default_params)
        >>> obs, state, reward, done, info = env.step(
        ...     jax.random.key(1), state, jnp.zeros(1), env.default_params)
        >>> obs.shape
        (5,)
    """
    require("to_rejax", "gymnax")
    check_environment("to_rejax", environment, params)
    return _classes()[1](environment, params)


@functools.cache
def _classes() -> tuple[type, type]:
    """Return the classes for gymnax and rejax. Their base class is gymnax's."""
    from gymnax.environments import environment as gymnax_environment
    from gymnax.environments import spaces

    class GymnaxEnv(gymnax_environment.Environment):
        """The interface of gymnax 1.0."""

        _supports_transition_gradients = True

        def __init__(self, environment: Environment, params: Params | None):
            self.environment = environment
            self.params = environment.default_params if params is None else params

        def __deepcopy__(self, memo: dict) -> Any:
            return self  # a static argument of compiled functions, compared by identity

        @property
        def name(self) -> str:
            return self.environment.task.name

        @property
        def default_params(self) -> GymnaxParams:
            return GymnaxParams(self.params, self.environment.episode)

        @property
        def num_actions(self) -> int:
            return self.environment.action_size

        def _own(self, where: str, params: GymnaxParams | None) -> Params:
            given = self.default_params if params is None else params
            expected = "GymnaxParams, such as env.default_params"
            instance(where, "params", given, GymnaxParams, expected)
            return given.params

        def reset_env(self, key: jax.Array, params: GymnaxParams) -> tuple[Any, EnvState]:
            return self.environment.reset(key, self._own("reset", params))

        def step_env(
            self, key: jax.Array, state: EnvState, action: Any, params: GymnaxParams
        ) -> tuple:
            action = jnp.reshape(action, (self.num_actions,))
            obs, state, reward, _, info = self.environment.step_once(
                key, state, action, self._own("step", params)
            )
            obs, state = self._apply_transition_gradient_policy(finite(obs, info["failed"]), state)
            terminated = info["terminated"]
            info = {"failed": info["failed"], "rewards": info["rewards"]}
            return obs, state, reward, terminated, info | {"discount": 1.0 - terminated}

        def is_truncated(self, state: EnvState, params: GymnaxParams) -> jax.Array:
            return state.step >= jnp.minimum(params.max_steps_in_episode, self.environment.episode)

        def action_space(self, params: GymnaxParams | None = None) -> Any:
            low, high = (jnp.asarray(np.asarray(x)) for x in self.environment.action_range)
            return spaces.Box(low, high, (self.num_actions,), low.dtype)

        def observation_space(self, params: GymnaxParams | None = None) -> Any:
            sizes, dtype = self.environment.observation_size, self.params.noise.dtype

            def box(n: int) -> Any:
                return spaces.Box(-jnp.inf, jnp.inf, (n,), dtype)

            if isinstance(sizes, dict):
                return spaces.Dict({name: box(n) for name, n in sizes.items()})
            return box(sizes)

    class RejaxEnv(GymnaxEnv):
        """The interface that rejax 0.1 expects."""

        def reset(self, key: jax.Array, params: GymnaxParams | None = None) -> tuple:
            obs, state = self.environment.reset(key, self._own("reset", params))
            return self._policy(obs), state

        def step(
            self, key: jax.Array, state: EnvState, action: Any, params: GymnaxParams | None = None
        ) -> tuple:
            action, given = jnp.reshape(action, (self.num_actions,)), self._own("step", params)
            obs, state, reward, done, info = self.environment.step(key, state, action, given)
            return self._policy(obs), state, reward, done, info

        def observation_space(self, params: GymnaxParams | None = None) -> Any:
            space = super().observation_space(params)
            return space.spaces["policy"] if isinstance(space, spaces.Dict) else space

        def _policy(self, obs: Any) -> jax.Array:
            return obs["policy"] if isinstance(obs, dict) else obs

    return GymnaxEnv, RejaxEnv
