"""The gymnax adapter, with gymnax' own rollout, and rejax' PPO."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnax.environments import spaces
from gymnax.environments.environment import Environment as GymnaxEnvironment

from rbjax.envs import adapters
from rbjax.errors import InputError
from tests.envs.adapters.small_task import environment


@pytest.fixture(scope="module")
def env():
    return environment(episode=30)


@pytest.fixture(scope="module")
def path(env):
    """A batch under gymnax' own `step`, with forces of -3..3 N: 5 environments, 70 steps."""
    adapter = adapters.to_gymnax(env)
    params = adapter.default_params
    keys = jax.random.split(jax.random.key(0), 5)
    first = jax.vmap(adapter.reset, (0, None))(keys, params)

    def one(carry, key):
        obs, state = carry
        after, now, *rest = jax.vmap(adapter.step, (0, 0, 0, None))(
            jax.random.split(key, 5), state, jnp.linspace(-3, 3, 5)[:, None], params
        )
        return (after, now), (obs, state.step, after, now.step, *rest)

    keys = jax.random.split(jax.random.key(1), 70)
    return jax.tree.map(np.asarray, jax.jit(lambda: jax.lax.scan(one, first, keys)[1])())


def test_it_is_an_environment_of_gymnax(env):
    adapter = adapters.to_gymnax(env)
    assert isinstance(adapter, GymnaxEnvironment) and adapter.name == "balance"
    action = adapter.action_space(adapter.default_params)
    assert isinstance(action, spaces.Box) and (action.low, action.high) == (-20, 20)
    assert action.contains(action.sample(jax.random.key(0)))
    assert adapter.observation_space(adapter.default_params).shape == (4,)


def test_episodes_follow_each_other(path):
    obs, before, after, step, reward, terminated, truncated, info = path
    done = terminated | truncated
    assert (done.sum(0) >= 2).all() and terminated.any() and truncated.any()
    np.testing.assert_array_equal(step, np.where(done, 0, before + 1))
    np.testing.assert_array_equal(truncated & ~terminated, (before == 29) & ~terminated)
    assert (np.abs(after[done][:, :2]) < 0.052).all()  # 0.05 of the start, 0.001 of the noise
    last = info["final_observation"]
    assert (np.abs(last[terminated][:, 1]) > 0.299).all()  # ends at 0.3
    np.testing.assert_array_equal(last[~done], after[~done])
    np.testing.assert_array_equal(obs[1:], after[:-1])
    assert (reward > 0).all() and not info["failed"].any()
    np.testing.assert_array_equal(info["discount"], 1.0 - terminated)


def test_the_time_limit_is_a_parameter(env):
    adapter = adapters.to_gymnax(env)
    params = adapter.default_params.replace(max_steps_in_episode=3)
    _, state = adapter.reset(jax.random.key(0), params)
    cut = []
    for i in range(7):
        _, state, *_, truncated, _ = adapter.step(jax.random.key(i), state, jnp.zeros(1), params)
        cut.append(bool(truncated))
    assert cut == [False, False, True, False, False, True, False]


def test_gradients_pass_only_if_asked_for(env):
    adapter = adapters.to_gymnax(env)
    params = adapter.default_params
    _, state = adapter.reset(jax.random.key(0), params)

    def slope(chosen):
        def f(action):
            return chosen.step(jax.random.key(1), state, action, params)[0][2]  # the cart's speed

        return float(jax.grad(f)(jnp.ones(1))[0])

    assert slope(adapter) == 0.0
    # 1 N over 0.02 s on a cart of 1 kg; the pole of 0.1 kg takes a little, damping 0.05 per s
    assert slope(adapter.with_transition_gradients()) == pytest.approx(0.02, rel=0.05)


def test_groups_are_a_dictionary():
    adapter = adapters.to_gymnax(environment(critic=True))
    obs, _ = adapter.reset(jax.random.key(0))
    space = adapter.observation_space(adapter.default_params)
    assert {name: x.shape for name, x in obs.items()} == {"policy": (4,), "critic": (5,)}
    assert {name: x.shape for name, x in space.spaces.items()} == {"policy": (4,), "critic": (5,)}
    policy = adapters.to_rejax(environment(critic=True))
    assert policy.reset(jax.random.key(0))[0].shape == (4,)
    assert policy.observation_space(None).shape == (4,)


def test_the_step_for_rejax_is_that_of_the_environment(env):
    adapter, key, action = adapters.to_rejax(env), jax.random.key(2), jnp.full(1, 3.0)
    _, state = adapter.reset(key, adapter.default_params)
    found = adapter.step(key, state, action[0], adapter.default_params)  # rejax squeezes actions
    due = env.step(key, state, action, env.default_params)
    shorter = adapter.default_params.replace(max_steps_in_episode=1)  # of rejax' evaluation only
    jax.tree.map(np.testing.assert_array_equal, adapter.step(key, state, action, shorter), due)
    jax.tree.map(np.testing.assert_array_equal, found, due)


def test_ppo_of_rejax_learns_to_balance():
    rejax = pytest.importorskip("rejax", reason="needs rejax: pip install 'rbjax[envs]'")
    with jax.enable_x64(False):  # rejax mixes f32 and the default type
        adapter = adapters.to_rejax(environment(episode=100))
        ppo = rejax.get_algo("ppo").create(
            env=adapter, num_envs=32, num_steps=64, num_minibatches=8, num_epochs=4,
            learning_rate=1e-3, gamma=0.98, total_timesteps=40_960, eval_freq=20_480,
            normalize_observations=True,
        )  # fmt: skip
        _, (lengths, returns) = jax.jit(ppo.train)(jax.random.key(0))
        mean = np.asarray(lengths.mean(-1))
    assert mean.shape == (3,) and np.isfinite(returns).all()
    assert mean[-1] > 2 * mean[0]


def test_wrong_arguments_are_told(env):
    for make in (adapters.to_gymnax, adapters.to_rejax):
        with pytest.raises(InputError, match=r"expected an rb\.envs\.Environment"):
            make(env.task)
        made = make(env)
        with pytest.raises(InputError, match=r"params is .* expected GymnaxParams"):
            made.reset(jax.random.key(0), env.default_params)
