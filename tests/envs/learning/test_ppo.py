"""PPO by Brax: its networks become policies of rbjax with the same actions; a small training."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.envs import Observation
from rbjax.envs.learning import ppo
from rbjax.envs.learning.brax_networks import convert_critic
from rbjax.errors import InputError, RbjaxError
from tests.envs.learning.pole import KEY, environment, observe

pytest.importorskip("brax")

SMALL = {
    "steps": 200, "num_envs": 4, "batch_size": 8, "num_minibatches": 2, "unroll_length": 3,
    "num_updates_per_batch": 1, "policy_hidden": (8, 4), "value_hidden": (8,), "evaluations": 4,
}  # fmt: skip


@pytest.mark.slow
def test_the_policy_and_the_critic_are_those_of_brax(caplog):
    """A training of two reports with two groups of observations; the mean action and the value of
    Brax' networks, with its own parameters, and a report with the terms of the reward. Parameters
    that are passed are used, in place of the curriculum: a reward of twice the weight. Three
    evaluations are compiled once."""
    from brax.training.acme import running_statistics
    from brax.training.agents.ppo import networks

    seen, kept = [], {}
    groups = {"policy": (Observation("q", lambda to: to.after.q),),
              "critic": (Observation("state", observe),)}  # fmt: skip
    with jax.enable_x64(False), jax.log_compiles():
        env = environment(observations=groups, curriculum=lambda params, progress: params)
        params = env.default_params.replace(weights={"upright": jnp.asarray(2.0)})
        found = ppo(
            env, KEY, reports=2, params=params, **SMALL,
            report=lambda steps, figures, policy: seen.append((steps, figures, policy)),
            keep=kept.update,
        )  # fmt: skip
        sizes = {"state": (2,), "privileged_state": (4,)}
        made = networks.make_ppo_networks(
            sizes, 1, running_statistics.normalize, (8, 4), (8,), value_obs_key="privileged_state"
        )
        obs = {"policy": jnp.array([0.3, -0.2]), "critic": jnp.array([0.3, -0.2, 1.0, 2.0])}
        parameters = kept["parameters"]
        act = networks.make_inference_fn(made)(parameters, deterministic=True)
        theirs = {"state": obs["policy"], "privileged_state": obs["critic"]}
        want = 20.0 * act(theirs, KEY)[0]  # the range of the force
        assert np.abs(found.policy(obs) - want).max() < 1e-5
        V = made.value_network.apply(parameters[0], parameters[2], theirs)
        assert abs(convert_critic(parameters, "privileged_state", 0.5)(obs) - 0.5 * V) < 1e-6
    assert seen[0][0] == 0 and len(seen) == 3
    compiled = [x for x in caplog.messages if x.startswith("Compiling jit(generate_eval_unroll)")]
    assert len(compiled) == 1
    assert seen[1][0] < seen[2][0] >= 200
    assert {"reward", "reward_std", "length", "reward/upright"} <= set(seen[1][1])
    assert seen[0][1]["reward"] > 6 and seen[0][1]["failed"] == 0  # 5 with the weight of the task
    assert abs(seen[1][1]["reward"] - seen[1][1]["reward/upright"]) < 1e-4
    assert seen[1][2].network.sizes == (2, 8, 4, 2)
    assert found.rewards.shape == (3,) and np.isfinite(found.rewards).all()


@pytest.mark.slow
def test_a_training_continues():
    """From the parameters that `keep` was given: its first evaluation is that of the last one."""
    with jax.enable_x64(False):
        kept, rewards = {}, []
        more = {"reports": 1, "report": lambda steps, figures, _: rewards.append(figures["reward"])}
        ppo(environment(), KEY, keep=kept.update, **SMALL, **more)
        policy = kept["parameters"][1]
        again = {}
        ppo(environment(), KEY, restore=kept, keep=lambda x: again.setdefault("first", x),
            **SMALL, **more)  # fmt: skip
    start = again["first"]["parameters"][1]
    for a, b in zip(jax.tree.leaves(policy), jax.tree.leaves(start), strict=True):
        np.testing.assert_array_equal(a, b)
    assert np.isfinite(rewards).all()


def test_the_defaults_fit_each_other():
    given = {name: x.default for name, x in inspect.signature(ppo).parameters.items()}
    assert given["batch_size"] * given["num_minibatches"] % given["num_envs"] == 0


def test_bad_input():
    with pytest.raises(InputError, match=r"batch_size \* num_minibatches is 16"):
        ppo(environment(), KEY, **SMALL | {"num_envs": 5})
    with pytest.raises(InputError, match="factor 1 - discounting"):
        ppo(environment(), KEY, discounting=1, **SMALL)
    for changes, part in (
        ({"reward_scaling": -1.0}, "reward_scaling is"), ({"evaluations": 0}, "evaluations is"),
        ({"learning_rate": np.nan}, "learning_rate is"), ({"devices": 1000}, "devices is 1000"),
        ({"num_timesteps": 5}, "unknown setting"), ({"seed": 5}, "unknown setting"),
        ({"num_minibatches": 0}, "num_minibatches is"),
        *(({"restore": x}, "restore is") for x in (3, {"a": 1}, (1, 2), "folder")),
    ):  # fmt: skip
        with pytest.raises(RbjaxError, match=part):
            ppo(environment(), KEY, **SMALL | changes)
    harder = environment(curriculum=lambda params, progress: params)
    with pytest.raises(InputError, match=r"has a curriculum.*learning\.shac"):
        ppo(harder, KEY, **SMALL)
