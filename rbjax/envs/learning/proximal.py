"""Proximal policy optimisation (PPO), by Brax.

    L = E[min(r A, clip(r, 1 - e, 1 + e) A)],      r = pi(a | o) / pi_old(a | o)

Brax trains; rbjax simulates. The trained networks become a `Policy` and a `Critic` of rbjax, so
that checkpoints, gradients and controllers need no Brax.
Sources: Schulman et al., *Proximal policy optimization algorithms*, 2017; Freeman et al., *Brax*,
2021.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import choice, integer, real_number, shown
from rbjax.envs.adapters import to_brax, wrap_brax
from rbjax.envs.learning.brax_networks import convert_critic, convert_policy
from rbjax.envs.learning.checks import check_discount, check_hidden, check_training
from rbjax.envs.learning.critic import Critic
from rbjax.envs.learning.iterations import devices_of
from rbjax.envs.learning.policy import Policy
from rbjax.envs.learning.trained import Report, Trained, no_report
from rbjax.errors import InputError
from rbjax.optional import require

#: arguments of Brax that `ppo` sets
SET_HERE = (
    "environment", "wrap_env_fn", "num_timesteps", "episode_length", "network_factory", "seed",
    "normalize_observations", "num_evals", "num_eval_envs", "deterministic_eval", "progress_fn",
    "policy_params_fn", "max_devices_per_host", "restore_params",
)  # fmt: skip


class TimeIsUp(Exception):
    """The limit of time is over; Brax stops."""


def ppo(
    env: Any,
    key: jax.Array,
    *,
    steps: int = 20_000_000,
    num_envs: int = 2048,
    batch_size: int = 256,
    num_minibatches: int = 32,
    policy_hidden: tuple[int, ...] = (128, 128, 128),
    value_hidden: tuple[int, ...] = (256, 256, 256),
    discounting: float = 0.97,
    reward_scaling: float = 1.0,
    devices: int | None = None,
    reports: int = 10,
    evaluations: int = 128,
    report: Report = no_report,
    seconds: float | None = None,
    params: Any = None,
    restore: Any = None,
    keep: Callable[[dict[str, Any]], None] = lambda parameters: None,
    **settings: Any,
) -> Trained:
    """Train a policy by PPO of Brax.

    Use it for tasks whose rewards or contacts have no useful gradient, and as a baseline.

    Args:
        env: `rb.envs.Environment`.
        key: of `jax.random`.
        steps: steps of the robot in the training, at least.
        num_envs: number of parallel samples.
        batch_size, num_minibatches: samples of a minibatch, and the number of minibatches; their
            product is a multiple of `num_envs`.
        policy_hidden, value_hidden: sizes of the hidden layers.
        discounting: g of a step, below 1.
        reward_scaling: factor of the rewards inside PPO, above 0.
        devices: number of devices that share the samples; None for one.
        reports: number of evaluations during the training, each with a report. There is one more
            before the training, after 0 steps.
        evaluations: number of episodes of an evaluation.
        report: function (steps so far, figures, policy), called after each evaluation; the policy
            of the one after 0 steps is None.
        seconds: limit of time, after which the training ends with the next report; None for none.
        params: parameters of the environment for the whole training; None for
            `env.default_params`. Brax does not apply `Task.curriculum`.
        restore: Brax' parameters of an earlier training, to continue from, or the dict that `keep`
            was given; None for none.
        keep: function that is given {"parameters": Brax' parameters} before each report.
        settings: further arguments of `brax.training.agents.ppo.train.train`, such as
            `unroll_length`, `num_updates_per_batch`, `learning_rate`, `entropy_cost`,
            `clipping_epsilon`, `max_grad_norm`.

    Returns:
        `Trained`; `rewards` are the returns of the evaluations, (reports + 1,).

    Raises:
        InputError: Brax is not installed, settings that do not fit each other, or a task with a
            curriculum without `params`.

    Source: Schulman et al., *Proximal policy optimization algorithms*, 2017.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.learning.settings("cart_pole_balance", "ppo", "gpu")["unroll_length"]
        30
    """
    check_training("ppo", env, key, 1, num_envs, None, report, seconds)
    policy_hidden, value_hidden = (check_hidden("ppo", x) for x in (policy_hidden, value_hidden))
    for name, count in (
        ("batch_size", batch_size), ("num_minibatches", num_minibatches), ("steps", steps),
        ("reports", reports), ("evaluations", evaluations),
    ):  # fmt: skip
        integer("ppo", name, count, least=1)
    check_discount("ppo", "discounting", discounting)
    real_number("ppo", "reward_scaling", reward_scaling, above=0.0)
    if "learning_rate" in settings:
        real_number("ppo", "learning_rate", settings["learning_rate"], above=0.0)
    where_to_run = devices_of("ppo", devices, num_envs)
    if env.task.curriculum is not None and params is None:
        raise InputError(
            f"ppo: task {env.task.name!r} has a curriculum, expected none, because Brax does not "
            "apply it; use rb.envs.learning.shac, or pass the parameters of the whole training, "
            "such as params=env.default_params"
        )
    batch = batch_size * num_minibatches
    if batch % num_envs:
        raise InputError(
            f"ppo: batch_size * num_minibatches is {batch}, expected a multiple of num_envs, "
            f"{num_envs}"
        )
    if isinstance(restore, Mapping) and "parameters" in restore:
        restore = restore["parameters"]
    if restore is not None and not (isinstance(restore, tuple | list) and len(restore) == 3):
        raise InputError(
            f"ppo: restore is {shown(restore)}, expected the three parameters of Brax (statistics, "
            "policy, value), or the dict that keep= was given"
        )
    brax_env = to_brax(env, params)
    make_ppo_networks = require("ppo", "brax.training.agents.ppo.networks").make_ppo_networks
    brax_train = require("ppo", "brax.training.agents.ppo.train").train
    known = [x for x in inspect.signature(brax_train).parameters if x not in SET_HERE]
    for name in settings:
        choice("setting of PPO of Brax", name, known)
    groups = brax_env.observation_size
    critic_group = "state"
    if isinstance(groups, dict) and "privileged_state" in groups:
        critic_group = "privileged_state"
    factory = functools.partial(
        with_compiled_starts,
        make_ppo_networks,
        policy_hidden_layer_sizes=policy_hidden,
        value_hidden_layer_sizes=value_hidden,
        value_obs_key=critic_group,
    )
    began, rewards, last = time.perf_counter(), [], {}

    def remember(done: int, make: Any, parameters: Any) -> None:
        last["parameters"] = parameters
        keep({"parameters": parameters})

    def convert() -> tuple[Policy, Critic]:
        made = convert_policy(env, last["parameters"])
        factor = (1 - discounting) / reward_scaling
        return made, convert_critic(last["parameters"], critic_group, factor)

    def progress(done: int, metrics: Mapping[str, Any]) -> None:
        figures = figures_of(metrics)
        rewards.append(figures["reward"])
        report(int(done), figures, convert()[0] if last else None)
        if seconds is not None and done and time.perf_counter() - began > seconds:
            raise TimeIsUp

    words = np.asarray(jax.random.key_data(key)).ravel()
    seed = int(np.random.SeedSequence(words.tolist()).generate_state(1)[0] >> 1)  # 31 bits
    try:
        _, parameters, _ = brax_train(
            environment=brax_env, wrap_env_fn=wrap_brax, num_timesteps=steps,
            num_envs=num_envs, episode_length=env.episode, network_factory=factory,
            normalize_observations=True, discounting=discounting,
            reward_scaling=reward_scaling, seed=seed, num_evals=reports + 1,
            num_eval_envs=evaluations, deterministic_eval=True, progress_fn=progress,
            policy_params_fn=remember, max_devices_per_host=len(where_to_run),
            restore_params=restore, batch_size=batch_size, num_minibatches=num_minibatches,
            **settings,
        )  # fmt: skip
        last["parameters"] = parameters
    except TimeIsUp:
        pass
    policy, critic = convert()
    return Trained(policy, critic, np.asarray(rewards), jnp.zeros((), int))


def with_compiled_starts(make: Callable, *args: Any, **settings: Any) -> Any:
    """Return the networks of Brax that `make` makes, whose initial parameters are one program.

    Brax draws them operation by operation, each a program of its own, which takes seconds.
    """
    made = make(*args, **settings)
    names = ("policy_network", "value_network")
    nets = {name: getattr(made, name) for name in names}
    compiled = {n: dataclasses.replace(net, init=jax.jit(net.init)) for n, net in nets.items()}
    return dataclasses.replace(made, **compiled)


def figures_of(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Return the figures of an evaluation by Brax as one row.

    "reward", "reward_std": return of an episode, its mean and standard deviation. "length": steps
    of an episode. "reward/NAME": mean sum of a weighted reward term, not multiplied by dt.
    "failed": share of the episodes that a state that is not finite ended. "training/NAME": of PPO.
    """
    named = {
        "reward": metrics.get("eval/episode_reward", np.nan),
        "reward_std": metrics.get("eval/episode_reward_std", np.nan),
        "length": metrics.get("eval/avg_episode_length", np.nan),
    }
    for name, x in metrics.items():
        if name.startswith("eval/episode_") and not name.endswith("_std"):
            term = name.removeprefix("eval/episode_")
            named |= {term: x} if term.startswith("reward/") or term == "failed" else {}
        elif name.startswith("training/"):
            named[name] = x
    return {name: float(x) for name, x in named.items()}
