"""Gymnasium: one environment, a batch of environments with numpy arrays, and a functional one.

A learning library that knows only numpy arrays is fed by `to_gymnasium_vector`: a step of the batch
runs on the device, its observations are copied to the host.
Observations of a state that is not finite are zero: the episode ends, and `info["failed"]` is True.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, integer
from rbjax.envs.adapters.arguments import check_environment
from rbjax.envs.environment import Environment
from rbjax.envs.episode import EnvState, Params
from rbjax.errors import InputError
from rbjax.lanes.arrays import select
from rbjax.optional import require

AUTORESET = ("next_step", "same_step", "disabled")


class FunctionalState(NamedTuple):
    """State of the functional environment: the episode, and what its last step returned."""

    episode: EnvState
    obs: Any
    reward: jax.Array
    terminated: jax.Array
    truncated: jax.Array
    failed: jax.Array
    rewards: dict[str, jax.Array]


def to_gymnasium(environment: Environment, params: Params | None = None) -> Any:
    """Return a `gymnasium.Env` of an environment, with numpy arrays.

    Use it to try a policy, and with tools that take one environment. A batch is much faster:
    `to_gymnasium_vector`.

    Args:
        environment: an `rb.envs.Environment`.
        params: parameters; None for `environment.default_params`.
            `Task.curriculum` is not applied.

    Returns:
        A `gymnasium.Env`. `info` has "failed" and "rewards" (name -> reward term). It has an
        attribute `state`, the `EnvState` of the episode.

    Raises:
        InputError: Gymnasium is not installed, or not an environment.

    Source: Towers et al., *Gymnasium*, 2024.

    Example:
        >>> import rbjax as rb
        >>> env = rb.envs.adapters.to_gymnasium(rb.envs.make("cart_pole_balance"))
        >>> obs, info = env.reset(seed=0)
        >>> obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        >>> obs.shape, terminated, truncated
        ((5,), False, False)
    """
    require("to_gymnasium", "gymnasium")
    check_environment("to_gymnasium", environment, params)
    return _classes()[0](environment, params)


def to_gymnasium_vector(
    environment: Environment,
    num_envs: int,
    params: Params | None = None,
    *,
    autoreset: str = "next_step",
) -> Any:
    """Return a `gymnasium.vector.VectorEnv` of an environment, with numpy arrays.

    Args:
        environment: an `rb.envs.Environment`.
        num_envs: number of environments of the batch.
        params: parameters; None for `environment.default_params`.
            `Task.curriculum` is not applied.
        autoreset: when an environment whose episode ended is reset, as in Gymnasium:
            "next_step": the next call of `step` resets it, and ignores its action.
            "same_step": the same call; `info["final_obs"]` has the last observation.
            "disabled": the caller does, by `reset(options={"reset_mask": ...})`.

    Returns:
        A `gymnasium.vector.VectorEnv` with `metadata["autoreset_mode"]`.

    Raises:
        InputError: Gymnasium is not installed, not an environment, no environments.
        UnknownName: another `autoreset`.

    Source: Towers et al., *Gymnasium*, 2024; https://farama.org/Vector-Autoreset-Mode.

    Example:
        >>> import rbjax as rb
        >>> envs = rb.envs.adapters.to_gymnasium_vector(rb.envs.make("cart_pole_balance"), 8)
        >>> obs, info = envs.reset(seed=0)
        >>> obs, reward, terminated, truncated, info = envs.step(envs.action_space.sample())
        >>> obs.shape, reward.shape
        ((8, 5), (8,))
    """
    require("to_gymnasium_vector", "gymnasium")
    check_environment("to_gymnasium_vector", environment, params)
    integer("to_gymnasium_vector", "num_envs", num_envs, least=1)
    choice("autoreset", autoreset, AUTORESET)
    return _classes()[1](environment, num_envs, params, autoreset)


def to_gymnasium_functional(environment: Environment, params: Params | None = None) -> Any:
    """Return a `gymnasium.experimental.functional.FuncEnv` of an environment, with JAX arrays.

    Its state is a `FunctionalState`. It has no time limit: `state.truncated` has that of the task,
    and `gymnasium.wrappers.TimeLimit` limits `FunctionalJaxEnv`.

    Args:
        environment: an `rb.envs.Environment`.
        params: parameters; None for `environment.default_params`.
            `Task.curriculum` is not applied.

    Raises:
        InputError: Gymnasium is not installed, or not an environment.

    Source: `gymnasium.experimental.functional` of Gymnasium 1.4.

    Example:
        >>> import jax, jax.numpy as jnp, rbjax as rb
        >>> env = rb.envs.adapters.to_gymnasium_functional(rb.envs.make("cart_pole_balance"))
        >>> state = env.initial(jax.random.key(0))
        >>> after = env.transition(state, jnp.zeros(1), jax.random.key(1))
        >>> env.observation(after, None).shape
        (5,)
    """
    require("to_gymnasium_functional", "gymnasium")
    check_environment("to_gymnasium_functional", environment, params)
    return _classes()[2](environment, params)


def finite(obs: Any, failed: jax.Array) -> Any:
    """Return observations, zero where the state was not finite."""
    return jax.tree.map(lambda x: jnp.where(failed, 0.0, x).astype(x.dtype), obs)


def spaces_of(environment: Environment) -> tuple[Any, Any]:
    """Return the spaces of observations and actions."""
    from gymnasium import spaces

    dtype: Any = environment.default_params.noise.dtype.type
    sizes = environment.observation_size

    def box(n: int) -> Any:
        return spaces.Box(-np.inf, np.inf, (n,), dtype)

    if isinstance(sizes, dict):
        observation: Any = spaces.Dict({name: box(n) for name, n in sizes.items()})
    else:
        observation = box(sizes)
    low, high = (np.asarray(x, dtype) for x in environment.action_range)
    return observation, spaces.Box(low, high, dtype=dtype)


@functools.cache
def _classes() -> tuple[type, type, type]:
    """Return the classes of one environment, of a batch, and of functions: bases of Gymnasium."""
    import gymnasium
    from gymnasium.experimental.functional import FuncEnv
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

    class GymnasiumEnv(gymnasium.Env):
        """One environment."""

        def __init__(self, environment: Environment, params: Params | None):
            self.environment, self.params = environment, params
            self.observation_space, self.action_space = spaces_of(environment)
            self.metadata = {"render_modes": [], "render_fps": round(1 / environment.dt)}
            self.state: EnvState | None = None
            self._key: Any = None

        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
            super().reset(seed=seed)
            self._key, key = jax.random.split(_key_of(self.np_random))
            obs, self.state = self.environment.reset(key, self.params)
            return _numpy(obs), {}

        def step(self, action: Any) -> tuple:
            if self.state is None:
                raise InputError("step: no episode, expected a call of reset before")
            self._key, key = jax.random.split(self._key)
            obs, self.state, reward, _, info = self.environment.step_once(
                key, self.state, jnp.asarray(action), self.params
            )
            failed = bool(info["failed"])
            rewards = {name: float(x) for name, x in info["rewards"].items()}
            return (
                _numpy(finite(obs, info["failed"])), float(reward), bool(info["terminated"]),
                bool(info["truncated"]), {"failed": failed, "rewards": rewards},
            )  # fmt: skip

    class GymnasiumVectorEnv(VectorEnv):
        """A batch of environments."""

        def __init__(
            self, environment: Environment, num_envs: int, params: Params | None, autoreset: str
        ):
            self.environment, self.params, self.num_envs = environment, params, num_envs
            self.single_observation_space, self.single_action_space = spaces_of(environment)
            self.observation_space = batch_space(self.single_observation_space, num_envs)
            self.action_space = batch_space(self.single_action_space, num_envs)
            mode = AutoresetMode[autoreset.upper()]
            self.metadata = {"autoreset_mode": mode, "render_fps": round(1 / environment.dt)}
            self.render_mode, self.spec = None, None
            self.state: EnvState | None = None
            self._obs: Any = None
            self._autoreset, self._done = autoreset, jnp.zeros(num_envs, bool)
            self._key: Any = None
            self._reset = jax.jit(self._begin)
            self._step = jax.jit(self._advance)

        def _begin(self, key: jax.Array, params: Params | None) -> tuple:
            one = jax.vmap(self.environment.reset, (0, None))
            return one(jax.random.split(key, self.num_envs), params)

        def _advance(
            self, key: jax.Array, state: EnvState, action: Any, done: Any, params: Any
        ) -> tuple:
            key, begin, advance = jax.random.split(key, 3)
            one = jax.vmap(self.environment.step_once, (0, 0, 0, None))
            obs, now, reward, _, info = one(
                jax.random.split(advance, self.num_envs), state, action, params
            )
            last = jax.vmap(finite)(obs, info["failed"])
            kept = {"failed": info["failed"], "rewards": info["rewards"]}
            result = reward, info["terminated"], info["truncated"], kept
            pick = done if self._autoreset == "next_step" else result[1] | result[2]
            obs = last
            if self._autoreset != "disabled":
                obs, now = jax.vmap(select)(pick, self._begin(begin, params), (last, now))
            if self._autoreset == "next_step":  # a call that resets has no result
                result = jax.vmap(select)(pick, jax.tree.map(jnp.zeros_like, result), result)
            return key, now, result[1] | result[2], last, (obs, *result)

        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple:
            super().reset(seed=seed)
            self._key, key = jax.random.split(_key_of(self.np_random))
            obs, state = self._reset(key, self.params)
            mask = (options or {}).get("reset_mask")
            if mask is not None:
                mask = self._checked(mask)
                obs, state = jax.vmap(select)(
                    jnp.asarray(mask), (obs, state), (self._obs, self.state)
                )
            self._obs, self.state = obs, state
            self._done = jnp.zeros(self.num_envs, bool) if mask is None else self._done & ~mask
            return _numpy(obs), {}

        def step(self, actions: Any) -> tuple:
            if self.state is None:
                raise InputError("step: no episodes, expected a call of reset before")
            due = self.num_envs, self.environment.action_size
            if np.shape(actions) != due:
                raise InputError(
                    f"step: actions has shape {np.shape(actions)}, expected {due}, one row an "
                    "environment"
                )
            self._key, self.state, self._done, last, result = self._step(
                self._key, self.state, np.asarray(actions), self._done, self.params
            )
            self._obs = result[0]
            obs, reward, terminated, truncated, info = _numpy(result)
            info = _with_masks(info, self.num_envs)
            done = terminated | truncated
            if self._autoreset == "same_step" and done.any():
                info["final_info"], info["_final_info"] = dict(info), done
                info["final_obs"], info["_final_obs"] = _final(_numpy(last), done), done.copy()
            return obs, reward, terminated, truncated, info

        def _checked(self, mask: Any) -> np.ndarray:
            mask, due = np.asarray(mask), (self.num_envs,)
            if self.state is None or mask.shape != due or mask.dtype != bool or not mask.any():
                raise InputError(
                    f'reset: options["reset_mask"] has shape {mask.shape} and dtype {mask.dtype}, '
                    f"expected bool {due} with a True, after a first reset"
                )
            return mask

    class GymnasiumFunctionalEnv(FuncEnv):
        """Pure functions of one environment."""

        def __init__(self, environment: Environment, params: Params | None):
            self.environment, self.params = environment, params
            self.observation_space, self.action_space = spaces_of(environment)
            super().__init__()

        def get_default_params(self, **kwargs: Any) -> Params:
            return self.environment.default_params if self.params is None else self.params

        def _given(self, params: Params | None) -> Params | None:
            return self.params if params is None else params

        def initial(self, rng: Any, params: Params | None = None) -> FunctionalState:
            obs, episode = self.environment.reset(rng, self._given(params))
            zero, no = jnp.zeros_like(episode.episode_return), jnp.zeros((), bool)
            rewards = {r.name: zero for r in self.environment.task.rewards}
            return FunctionalState(episode, obs, zero, no, no, no, rewards)

        def transition(
            self, state: FunctionalState, action: Any, rng: Any, params: Params | None = None
        ) -> FunctionalState:
            obs, episode, reward, _, info = self.environment.step_once(
                rng, state.episode, jnp.asarray(action), self._given(params)
            )
            names = ("terminated", "truncated", "failed", "rewards")
            terminated, truncated, failed, rewards = (info[name] for name in names)
            return FunctionalState(
                episode, finite(obs, failed), reward, terminated, truncated, failed, rewards
            )

        def observation(self, state: FunctionalState, rng: Any, params: Any = None) -> Any:
            return state.obs

        def reward(
            self, state: Any, action: Any, next_state: FunctionalState, rng: Any, params: Any = None
        ) -> jax.Array:
            return next_state.reward

        def terminal(self, state: FunctionalState, rng: Any, params: Any = None) -> jax.Array:
            return state.terminated

        def transition_info(
            self, state: Any, action: Any, next_state: FunctionalState, params: Any = None
        ) -> dict[str, Any]:
            return {
                "truncated": next_state.truncated, "failed": next_state.failed,
                "rewards": dict(next_state.rewards),
            }  # fmt: skip

    return GymnasiumEnv, GymnasiumVectorEnv, GymnasiumFunctionalEnv


def _key_of(generator: np.random.Generator) -> jax.Array:
    return jax.random.key(generator.integers(2**31))


def _numpy(tree: Any) -> Any:
    """Return a copy as numpy arrays, which the caller may change."""
    return jax.tree.map(np.array, jax.device_get(tree))


def _with_masks(info: dict[str, Any], count: int) -> dict[str, Any]:
    """Return info of a batch with the masks "_name" that Gymnasium's wrappers read."""
    out = {}
    for name, value in info.items():
        out[name] = _with_masks(value, count) if isinstance(value, dict) else value
        out[f"_{name}"] = np.ones(count, bool)
    return out


def _final(obs: Any, done: np.ndarray) -> np.ndarray:
    """Return an array of objects: the last observation of each ended episode, else None."""
    out = np.full(done.shape, None, dtype=object)
    for i in np.flatnonzero(done):
        out[i] = jax.tree.map(lambda x, i=i: x[i].copy(), obs)
    return out
