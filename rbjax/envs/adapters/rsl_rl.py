"""rsl-rl: a `VecEnv` with PyTorch tensors.

JAX and PyTorch share the memory of observations, rewards and actions (DLPack), on a GPU and on the
processor: nothing is copied. A step is one kernel, or three if
the robot has contacts, with the reset of ended episodes.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import integer
from rbjax.envs.adapters.arguments import check_environment
from rbjax.envs.environment import Environment
from rbjax.envs.episode import EnvState, Params
from rbjax.optional import require


def to_rsl_rl(
    environment: Environment, num_envs: int, params: Params | None = None, *, seed: int = 0
) -> Any:
    """Return an `rsl_rl.env.VecEnv` of an environment, for the runners of rsl-rl.

    Args:
        environment: an `rb.envs.Environment`.
        num_envs: number of environments of the batch.
        params: parameters; None for `environment.default_params`. `Task.curriculum` is
            not applied; the attribute `params` may be set between steps instead.
        seed: seed of the random numbers.

    Returns:
        A `VecEnv`. Observations are a `TensorDict` with the groups of the task, "policy" and
        perhaps "critic". `extras` has "time_outs" and "log": the mean reward terms, "/reward/name",
        and the fraction of failed states, "/failed".

    Raises:
        InputError: rsl-rl or PyTorch is not installed, not an environment, no environments.

    Source: Schwarke et al., *RSL-RL*, 2025; version 5.5.

    Example:
        >>> import rbjax as rb
        >>> env = rb.envs.make("cart_pole_balance")
        >>> rb.envs.adapters.to_rsl_rl(env, 64).num_actions  # doctest: +SKIP
        1
    """
    for package in ("torch", "tensordict", "rsl_rl"):
        require("to_rsl_rl", package)
    check_environment("to_rsl_rl", environment, params)
    integer("to_rsl_rl", "num_envs", num_envs, least=1)
    integer("to_rsl_rl", "seed", seed, least=0)
    return _class()(environment, num_envs, params, seed)


@functools.cache
def _class() -> type:
    """Return the class, whose base class is that of rsl-rl."""
    import torch
    from rsl_rl.env import VecEnv
    from tensordict import TensorDict

    class RslRlEnv(VecEnv):
        """A batch of environments with PyTorch tensors."""

        def __init__(
            self, environment: Environment, num_envs: int, params: Params | None, seed: int
        ):
            self.environment, self.params = environment, params
            self.num_envs, self.num_actions = num_envs, environment.action_size
            self.max_episode_length = environment.episode
            self.cfg: dict = {"task": environment.task.name, "num_envs": num_envs, "seed": seed}
            self._step, self._begin = jax.jit(self._advance), jax.jit(self._initial)
            self._key = jax.random.key(seed)
            self.reset()

        def _initial(self, key: jax.Array, params: Params | None) -> tuple:
            key, begin = jax.random.split(key)
            keys = jax.random.split(begin, self.num_envs)
            return key, *jax.vmap(self.environment.reset, (0, None))(keys, params)

        def _advance(
            self, key: jax.Array, state: EnvState, action: jax.Array, params: Params | None
        ) -> tuple:
            key, advance = jax.random.split(key)
            keys = jax.random.split(advance, self.num_envs)
            obs, state, reward, done, info = jax.vmap(self.environment.step, (0, 0, 0, None))(
                keys, state, action, params
            )
            log = {f"/reward/{name}": jnp.mean(x) for name, x in info["rewards"].items()}
            log["/failed"] = jnp.mean(info["failed"])
            return key, obs, state, reward, done, info["truncated"], log

        def reset(self) -> tuple[Any, dict]:
            """Begin new episodes in all environments."""
            begun = self._begin(self._key, self.params)
            # committed to its device, as tensors are; else the second step would be compiled again
            self._key, obs, self.state = jax.device_put(begun, *begun[2].episode_return.devices())
            self._obs = self._tensors(obs)
            return self._obs, {}

        def get_observations(self) -> Any:
            return self._obs

        def step(self, actions: Any) -> tuple[Any, Any, Any, dict]:
            action = jax.dlpack.from_dlpack(actions.detach().contiguous())
            self._key, obs, self.state, reward, done, truncated, log = self._step(
                self._key, self.state, action, self.params
            )
            self._obs = self._tensors(obs)
            extras = {
                "time_outs": torch.from_dlpack(truncated),
                "log": {name: torch.from_dlpack(x) for name, x in log.items()},
            }
            return self._obs, torch.from_dlpack(reward), torch.from_dlpack(done), extras

        def _tensors(self, obs: Any) -> Any:
            groups = obs if isinstance(obs, dict) else {"policy": obs}
            tensors = {name: torch.from_dlpack(x) for name, x in groups.items()}
            return TensorDict(tensors, batch_size=[self.num_envs], device=self.device)

        @property
        def device(self) -> Any:
            """The device of the tensors."""
            return torch.from_dlpack(self.state.episode_return).device

        @property
        def episode_length_buf(self) -> Any:
            """Control steps of the running episodes, int32."""
            return torch.from_dlpack(self.state.step)

        @episode_length_buf.setter
        def episode_length_buf(self, steps: Any) -> None:
            steps = jax.dlpack.from_dlpack(steps.to(torch.int32).contiguous())
            self.state = self.state.replace(step=jnp.array(steps))

    return RslRlEnv
