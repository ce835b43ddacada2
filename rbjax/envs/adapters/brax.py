"""Brax: environments for `brax.training.agents.{ppo, sac, apg}.train`.

`to_brax` makes a `brax.envs.Env` of one sample. The trainers wrap it for a batch; `wrap_brax` is
the wrapper to give them. It resets within the step, to a new initial state, where the wrappers of
Brax return to the first one. A step of a batch is one kernel, or three if the robot has contacts.
Observations: the group "policy" is "state", the group "critic" is "privileged_state".
Actions: Brax acts in -1..1; actions are scaled to the range of the environment.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib
import types
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import integer
from rbjax.envs.actions import action_center_and_scale
from rbjax.envs.adapters.arguments import check_environment
from rbjax.envs.adapters.gymnasium import finite
from rbjax.envs.environment import Environment
from rbjax.envs.episode import Params
from rbjax.errors import InputError
from rbjax.optional import require

GROUPS = {"policy": "state", "critic": "privileged_state"}  # our name -> the name in Brax


def to_brax(
    environment: Environment, params: Params | None = None, *, privileged: bool = True
) -> Any:
    """Return a `brax.envs.Env` of an environment, for the trainers of Brax.

    Use it with `wrap_brax`: `ppo.train(to_brax(env), wrap_env_fn=wrap_brax, ...)`. With the default
    wrapper of Brax it works too, but slower, and episodes repeat their first initial state.

    Args:
        environment: an `rb.envs.Environment`.
        params: parameters; None for `environment.default_params`.
            `Task.curriculum` is not applied.
        privileged: whether observations have all groups of the task. False: the group "policy"
            only, as SAC and APG expect.

    Returns:
        A `brax.envs.Env`. `metrics` has the reward terms, "reward/name", and "failed", 1 if the
        state is not finite. The terms are weighted but not multiplied by dt, unlike the reward.

    Raises:
        InputError: Brax is not installed, or not an environment.

    Source: Freeman et al., *Brax*, 2021; `brax.envs.base` of Brax 0.14.

    Example:
        >>> import rbjax as rb
        >>> env = rb.envs.adapters.to_brax(rb.envs.make("cart_pole_balance"))
        >>> env.observation_size, env.action_size
        (5, 1)
    """
    require("to_brax", "brax")
    check_environment("to_brax", environment, params)
    return _classes()[0](environment, params, privileged)


def wrap_brax(
    env: Any,
    episode_length: int = 1000,
    action_repeat: int = 1,
    randomization_fn: Callable | None = None,
) -> Any:
    """Wrap an environment of `to_brax` for training: the `wrap_env_fn` of Brax' trainers.

    Args:
        env: environment of `to_brax`.
        episode_length: control steps in an episode, in place of those of the task.
        action_repeat: 1; `Task.decimation` repeats actions.
        randomization_fn: function of the model that returns the model with mapped leaves, and the
            axes of `jax.vmap`, as in Brax; in addition to the randomisation of the task.

    Returns:
        A `brax.envs.Env` of a batch. `info` has "truncation", "time_out", "steps", "episode_done"
        and "episode_metrics", as the wrappers of Brax return them.

    Raises:
        InputError: another environment, or another `action_repeat`.

    Example:
        >>> import jax, rbjax as rb
        >>> env = rb.envs.adapters.to_brax(rb.envs.make("cart_pole_balance"))
        >>> batch = rb.envs.adapters.wrap_brax(env, episode_length=100)
        >>> batch.reset(jax.random.split(jax.random.key(0), 4)).obs.shape
        (4, 5)
    """
    require("wrap_brax", "brax")
    one, batch = _classes()
    if not isinstance(env, one):
        raise InputError(
            f"wrap_brax: env is {type(env).__name__}, expected the result of to_brax(environment)"
        )
    integer("wrap_brax", "episode_length", episode_length, least=1)
    if integer("wrap_brax", "action_repeat", action_repeat, least=1) != 1:
        raise InputError(
            f"wrap_brax: action_repeat is {action_repeat}, expected 1; set Task.decimation to "
            "repeat an action over physics steps"
        )
    return batch(env, episode_length, randomization_fn)


@functools.cache
def _classes() -> tuple[type, type]:
    """Return the classes of one sample and of a batch. Their base class is Brax's."""
    from brax.envs.base import Env, State

    _adapt_trainers()

    class BraxEnv(Env):
        """One sample, without a reset within the step, as Brax's own wrappers expect it."""

        def __init__(self, environment: Environment, params: Params | None, privileged: bool):
            self.environment, self.params, self.privileged = environment, params, privileged

        @property
        def sys(self) -> Any:
            """The model, as an argument of `randomization_fn`."""
            return (self.params or self.environment.default_params).model

        @property
        def observation_size(self) -> Any:
            return self.renamed(self.environment.observation_size)

        @property
        def action_size(self) -> int:
            return self.environment.action_size

        @property
        def dt(self) -> float:
            """The control step in s."""
            return self.environment.dt

        @property
        def backend(self) -> str:
            return "rbjax"

        def renamed(self, groups: Any) -> Any:
            """Return observations with the names of Brax."""
            if not isinstance(groups, dict):
                return groups
            if not self.privileged:
                return groups["policy"]
            return {GROUPS.get(name, name): x for name, x in groups.items()}

        def scaled(self, action: jax.Array) -> jax.Array:
            """Return an action in the range of the environment."""
            low, high = (jnp.asarray(x, action.dtype) for x in self.environment.action_range)
            _, center, scale = action_center_and_scale(low, high)
            return center + scale * action

        def metrics(self, info: dict[str, Any] | None, zero: jax.Array) -> dict[str, jax.Array]:
            """Return the reward terms of a step, and whether it failed; zeros for None."""
            names = [r.name for r in self.environment.task.rewards]
            if info is None:
                return {f"reward/{name}": zero for name in names} | {"failed": zero}
            found = {f"reward/{name}": info["rewards"][name] for name in names}
            found["failed"] = info["failed"]
            return {name: x.astype(zero.dtype) for name, x in found.items()}

        def reset(self, rng: jax.Array) -> State:
            rng, key = jax.random.split(rng)
            obs, state = self.environment.reset(key, self.params)
            zero = jnp.zeros_like(state.episode_return)
            return State(
                state, self.renamed(obs), zero, zero, self.metrics(None, zero), {"rng": rng}
            )

        def step(self, state: State, action: jax.Array) -> State:
            rng, key = jax.random.split(state.info["rng"])
            obs, now, reward, _, info = self.environment.step_once(
                key, state.pipeline_state, self.scaled(action), self.params
            )
            return state.replace(
                pipeline_state=now,
                obs=self.renamed(finite(obs, info["failed"])),
                reward=reward,
                done=info["terminated"].astype(reward.dtype),
                metrics={**state.metrics, **self.metrics(info, reward)},
                info={**state.info, "rng": rng},
            )

    class BatchedBraxEnv(Env):
        """A batch, with a reset within the step. `info` is that of Brax's wrappers."""

        def __init__(self, env: BraxEnv, episode_length: int, randomization_fn: Callable | None):
            self.env, self.params, self._axes = env, env.params, None
            self.environment = env.environment
            if self.environment.episode != episode_length:
                task = dataclasses.replace(env.environment.task, episode=episode_length)
                self.environment = Environment(task, kernel=env.environment.kernel)
            if randomization_fn is not None:
                model, axes = randomization_fn(env.sys)
                given = env.params or self.environment.default_params
                self.params = given.replace(model=model)
                self._axes = jax.tree.map(lambda _: None, given).replace(model=axes)

        @property
        def observation_size(self) -> Any:
            return self.env.observation_size

        @property
        def action_size(self) -> int:
            return self.env.action_size

        @property
        def dt(self) -> float:
            """The control step in s."""
            return self.env.dt

        @property
        def backend(self) -> str:
            return self.env.backend

        @property
        def unwrapped(self) -> Env:
            return self.env

        def _map(self, f: Callable, *own: Any) -> Any:
            return jax.vmap(f, (*(0 for _ in own), self._axes))(*own, self.params)

        def reset(self, rng: jax.Array) -> State:
            keys = jax.vmap(jax.random.split)(rng)
            obs, state = self._map(self.environment.reset, keys[:, 1])
            zero = jnp.zeros_like(state.episode_return)
            metrics = self.env.metrics(None, zero)
            info = {
                "rng": keys[:, 0], "steps": zero, "truncation": zero, "time_out": zero,
                "episode_done": zero,
                "episode_metrics": {"sum_reward": zero, "length": zero, **metrics},
            }  # fmt: skip
            return State(state, self.env.renamed(obs), zero, zero, metrics, info)

        def step(self, state: State, action: jax.Array) -> State:
            old, running = state.info, 1 - state.done
            steps = jnp.where(state.done > 0, 0, old["steps"])  # which APG sets to random numbers
            keys = jax.vmap(jax.random.split)(old["rng"])
            before = state.pipeline_state.replace(step=steps.astype(jnp.int32))
            obs, now, reward, done, info = self._map(
                self.environment.step, keys[:, 1], before, self.env.scaled(action)
            )
            metrics = self.env.metrics(info, reward)
            truncation, done = (x.astype(reward.dtype) for x in (info["truncated"], done))
            terms = {"sum_reward": reward, "length": 1, **metrics}
            sums = {
                name: running * total + terms[name]
                for name, total in old["episode_metrics"].items()
            }
            return state.replace(
                pipeline_state=now,
                obs=self.env.renamed(obs),
                reward=reward,
                done=done,
                metrics={**state.metrics, **metrics},
                info={
                    **old, "rng": keys[:, 0], "steps": steps + 1, "truncation": truncation,
                    "time_out": truncation, "episode_done": done, "episode_metrics": sums,
                },
            )  # fmt: skip

    return BraxEnv, BatchedBraxEnv


def _adapt_trainers() -> None:
    """Give Brax' trainers `jax.device_put_replicated`, which JAX 0.10 removed, and PPO an evaluator
    that is compiled once.

    Without the first they raise an AttributeError (google/brax#671). JAX itself is not changed.
    """
    ppo = vars(importlib.import_module("brax.training.agents.ppo.train"))
    acting = ppo["acting"]
    ppo["acting"] = types.SimpleNamespace(**vars(acting) | {"Evaluator": _evaluator(acting)})
    ppo["_unpmap"] = _first_copy
    if hasattr(jax, "device_put_replicated"):
        return

    class Jax(types.ModuleType):
        device_put_replicated = staticmethod(_replicated)

        def __getattr__(self, name: str) -> Any:
            return getattr(jax, name)

    for name in ("agents.apg.train", "agents.ppo.train", "agents.sac.train", "pmap"):
        vars(importlib.import_module(f"brax.training.{name}"))["jax"] = Jax("jax")


def _evaluator(acting: types.ModuleType) -> type:
    """Return Brax' class `Evaluator` with the state of its episodes on a device from the beginning.

    In Brax it is there after the first evaluation only, so that the second one is compiled again.
    """

    class Evaluator(acting.Evaluator):  # type: ignore[name-defined]
        def __init__(self, *given: Any, **named: Any):
            super().__init__(*given, **named)
            state = getattr(self, "_eval_state_to_donate", None)
            self._eval_state_to_donate = jax.device_put(state, _sharding(jax.local_devices()[:1]))

    return Evaluator


def _first_copy(tree: Any) -> Any:
    """Return what the first device has, on the host.

    Brax slices each array on the device, which compiles a program for each shape, and the types of
    the parameters differ before and after an epoch, so that the evaluation is compiled twice.
    """
    return jax.tree.map(lambda x: np.asarray(x.addressable_shards[0].data)[0], tree)


def _sharding(devices: Any, *axes: str) -> Any:
    mesh = jax.sharding.Mesh(np.array(devices), ("i",))
    return jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec(*axes))


def _replicated(tree: Any, devices: Any) -> Any:
    """Return arrays with a leading axis, one copy on each device.

    They have no weak types, which Brax removes after an epoch; it would compile once more.
    """

    def leaf(x: Any) -> jax.Array:
        x = np.asarray(x)  # on the host, where no shape needs a program
        return jax.device_put(np.broadcast_to(x, (len(devices), *x.shape)), _sharding(devices, "i"))

    return jax.tree.map(leaf, tree)
