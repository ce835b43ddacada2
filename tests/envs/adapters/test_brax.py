"""The Brax adapter: the wrappers of Brax are the oracle of ours, and its trainers run unchanged."""

import functools

import brax.envs
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.envs.wrappers import training

from rbjax.envs import adapters
from rbjax.errors import InputError
from tests.eight_devices import on_eight_devices
from tests.envs.adapters.small_task import environment

EPISODE = 30
ACTIONS = jnp.tile(jnp.linspace(-0.15, 0.15, 5)[:, None], (70, 1, 1))  # of 20 N


@pytest.fixture(scope="module")
def env():
    return adapters.to_brax(environment(episode=EPISODE))


def unrolled(wrapped):
    """Run a batch under constant forces; return the states after each step."""
    first = wrapped.reset(jax.random.split(jax.random.PRNGKey(0), 5))

    def one(state, action):
        state = wrapped.step(state, action)
        return state, state

    return jax.tree.map(np.asarray, jax.jit(lambda: jax.lax.scan(one, first, ACTIONS)[1])())


@pytest.fixture(scope="module")
def ours(env):
    return unrolled(adapters.wrap_brax(env, EPISODE))


def running(path):
    """Whether a sample is in its first episode, its last step included."""
    ended = np.cumsum(path.done, axis=0) - path.done
    return ended == 0


def test_the_first_episodes_are_those_under_the_wrappers_of_brax(env, ours):
    theirs = unrolled(training.wrap(env, EPISODE))
    first = running(theirs)
    assert first.all(1).sum() < 40  # all end
    np.testing.assert_array_equal(first, running(ours))
    for name in ("reward", "done"):
        np.testing.assert_allclose(
            getattr(ours, name)[first], getattr(theirs, name)[first], rtol=1e-12
        )
    for name in ("steps", "truncation", "episode_done"):
        np.testing.assert_array_equal(ours.info[name][first], theirs.info[name][first])
    jax.tree.map(
        lambda a, b: np.testing.assert_allclose(a[first], b[first], rtol=1e-12),
        ours.info["episode_metrics"],
        theirs.info["episode_metrics"],
    )
    same = first & (theirs.done == 0)  # then ours is of the next episode
    np.testing.assert_allclose(ours.obs[same], theirs.obs[same], rtol=1e-12)


def test_later_episodes_begin_at_new_states(ours):
    """Whose bookkeeping begins anew, as under the wrappers of Brax."""
    done = ours.done > 0
    assert (done.sum(0) >= 2).all()
    assert (done & (ours.info["truncation"] > 0)).any() and (ours.info["steps"][done] < 30).any()
    assert (np.abs(ours.obs[done][:, :2]) < 0.052).all()  # 0.05 of the start, 0.001 of the noise
    starts = ours.pipeline_state.state.q[done]
    assert len(np.unique(starts, axis=0)) == len(starts)
    total, length = np.zeros(5), np.zeros(5)
    for i in range(len(done)):
        total, length = total + ours.reward[i], length + 1
        np.testing.assert_allclose(ours.info["episode_metrics"]["sum_reward"][i], total, rtol=1e-12)
        np.testing.assert_array_equal(ours.info["steps"][i], length)
        cut = (length == EPISODE) & (ours.info["truncation"][i] > 0)
        np.testing.assert_array_equal(ours.info["time_out"][i], cut)
        assert not (ours.info["truncation"][i].astype(bool) & ~done[i]).any()
        total, length = np.where(done[i], 0, total), np.where(done[i], 0, length)


def test_actions_are_scaled_to_the_range(env):
    """1 is 20 N, the limit of the cart."""
    state = env.step(env.reset(jax.random.key(0)), jnp.full(1, 0.5))
    assert state.pipeline_state.ctrl.tolist() == [10.0]
    assert state.metrics.keys() == {"reward/upright", "reward/effort", "failed"}
    np.testing.assert_allclose(state.metrics["reward/effort"], -1e-3 * 100, rtol=1e-12)


def test_a_key_is_used_once(env):
    """The key of the initial state is neither the key that the steps split nor the given one."""
    key = jax.random.key(7)
    kept, used = jax.random.split(key)
    due = env.environment.reset(used)[0]
    for given, state in (
        (kept, env.reset(key)),
        (kept[None], adapters.wrap_brax(env, EPISODE).reset(key[None])),
    ):
        assert (state.info["rng"] == given).all()
        np.testing.assert_allclose(np.ravel(state.obs), due, rtol=1e-12)


def test_a_failure_is_in_the_metrics(env):
    first = env.reset(jax.random.key(0))
    assert first.metrics["failed"] == 0 and env.step(first, jnp.zeros(1)).metrics["failed"] == 0
    now = first.pipeline_state
    now = now.replace(state=now.state.replace(v=jnp.full(2, 1e200)))
    after = env.step(first.replace(pipeline_state=now), jnp.zeros(1))
    assert after.metrics["failed"] == 1 and np.isfinite(after.obs).all()


def test_the_length_of_episodes_is_that_of_the_trainer(env):
    state = adapters.wrap_brax(env, 2)
    path = unrolled(state)
    assert path.info["truncation"][1::2].all() and not path.info["truncation"][::2].any()


def test_steps_may_be_set(env):
    """As APG does, with random numbers, so that episodes do not end together."""
    wrapped = adapters.wrap_brax(env, 10)
    state = wrapped.reset(jax.random.split(jax.random.key(0), 3))
    state.info["steps"] = jnp.array([0.0, 8.0, 9.0])
    state = wrapped.step(state, jnp.zeros((3, 1)))
    assert state.info["truncation"].tolist() == [0, 0, 1]
    assert state.info["steps"].tolist() == [1, 9, 10]
    state = wrapped.step(state, jnp.zeros((3, 1)))
    assert state.info["truncation"].tolist() == [0, 1, 0]
    assert state.info["steps"].tolist() == [2, 10, 1]
    assert state.pipeline_state.step.tolist() == [2, 0, 1]


def test_groups_have_the_names_of_brax():
    core = environment(critic=True)
    env = adapters.to_brax(core)
    assert env.observation_size == {"state": 4, "privileged_state": 5}
    obs = adapters.wrap_brax(env, 10).reset(jax.random.split(jax.random.key(0), 3)).obs
    assert {name: x.shape for name, x in obs.items()} == {
        "state": (3, 4),
        "privileged_state": (3, 5),
    }
    one = adapters.to_brax(core, privileged=False)
    assert one.observation_size == 4 and one.reset(jax.random.key(0)).obs.shape == (4,)


def test_a_randomisation_of_the_batch(env):
    """As Brax' scripts write it: a function of the model and keys. Heavy carts accelerate less."""

    def heavier(model, rng):
        mass = model.bodies.mass * (1.0 + jnp.arange(len(rng)))[:, None]
        batch = eqx.tree_at(lambda model: model.bodies.mass, model, mass)
        axes = jax.tree.map(lambda a, b: 0 if a.shape != b.shape else None, batch, model)
        return batch, axes

    rng = jax.random.split(jax.random.key(0), 4)
    wrapped = adapters.wrap_brax(env, 10, randomization_fn=functools.partial(heavier, rng=rng))
    state = wrapped.reset(rng)
    speed = state.pipeline_state.state.v[:, 0]
    state = wrapped.step(state, jnp.ones((4, 1)))
    gained = state.pipeline_state.state.v[:, 0] - speed
    # 20 N over 0.02 s on 1, 2, 3, 4 times 1 kg and the pole's part: 0.4 m/s and less
    np.testing.assert_allclose(gained, 0.39 / np.arange(1, 5), rtol=0.05)


def test_wrong_arguments_are_told(env):
    with pytest.raises(InputError, match=r"expected an rb\.envs\.Environment"):
        adapters.to_brax(env)
    with pytest.raises(InputError, match="expected the result of to_brax"):
        adapters.wrap_brax(environment())
    with pytest.raises(InputError, match=r"Task\.decimation"):
        adapters.wrap_brax(env, action_repeat=2)
    with pytest.raises(InputError, match="episode_length"):
        adapters.wrap_brax(env, 0)
    assert isinstance(env, brax.envs.Env)


def curve(train, env, **options):
    """Train without x64, which Brax does not support; return the evaluations."""
    found = []
    train(
        env, wrap_env_fn=adapters.wrap_brax, episode_length=100, num_eval_envs=32, num_evals=3,
        normalize_observations=True, progress_fn=lambda steps, metrics: found.append(metrics),
        **options,
    )  # fmt: skip
    found = [x for x in found if "eval/episode_reward" in x]  # others are of the training
    assert np.isfinite([x["eval/episode_reward"] for x in found]).all()
    assert all("eval/episode_reward/upright" in x for x in found)
    return [float(x["eval/avg_episode_length"]) for x in found]


def test_ppo_learns_to_balance():
    """With a value function of privileged observations, and parallel training metrics."""
    from brax.training.agents.ppo import networks
    from brax.training.agents.ppo import train as ppo

    with jax.enable_x64(False):
        env = adapters.to_brax(environment(critic=True))
        lengths = curve(
            ppo.train, env, num_timesteps=60_000, num_envs=64, unroll_length=10, batch_size=64,
            num_minibatches=8, num_updates_per_batch=4, learning_rate=1e-3, reward_scaling=5.0,
            bootstrap_on_timeout=True, log_training_metrics=True, training_metrics_steps=20_000,
            network_factory=functools.partial(
                networks.make_ppo_networks, policy_hidden_layer_sizes=(32, 32),
                value_hidden_layer_sizes=(64, 64), value_obs_key="privileged_state",
            ),
        )  # fmt: skip
    assert lengths[-1] > 2 * lengths[0]


def child_ppo() -> None:
    """The trainers of Brax map over devices by `jax.pmap`."""
    from brax.training.agents.ppo import train as ppo

    assert jax.local_device_count() == 8
    with jax.enable_x64(False):
        lengths = curve(
            ppo.train, adapters.to_brax(environment()), num_timesteps=20_000, num_envs=64,
            unroll_length=10, batch_size=64, num_minibatches=8, num_updates_per_batch=4,
            learning_rate=1e-3,
        )  # fmt: skip
    assert lengths[-1] > 1.5 * lengths[0]


def test_ppo_on_eight_devices():
    on_eight_devices(child_ppo)


def test_sac_trains():
    from brax.training.agents.sac import train as sac

    with jax.enable_x64(False):
        lengths = curve(
            sac.train, adapters.to_brax(environment()), num_timesteps=3000, num_envs=16,
            min_replay_size=500, batch_size=64, reward_scaling=10.0,
        )  # fmt: skip
    assert len(lengths) == 3


@pytest.mark.filterwarnings("ignore:optax.global_norm:DeprecationWarning")
def test_apg_learns_to_balance():
    """By gradients through the steps, which the kernel gives. At this rate each of four seeds
    balances to the end; at 1e-2 three of six trainings did."""
    from brax.training.agents.apg import train as apg

    with jax.enable_x64(False):
        lengths = curve(
            apg.train, adapters.to_brax(environment()), policy_updates=120, num_envs=16,
            horizon_length=16, learning_rate=3e-3,
        )  # fmt: skip
    assert lengths[-1] > 1.5 * lengths[0]
