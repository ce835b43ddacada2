"""The Gymnasium adapters, with Gymnasium's own checker."""

import itertools

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.envs.functional_jax_env import FunctionalJaxEnv
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import DictInfoToList, RecordEpisodeStatistics

import rbjax as rb
from rbjax.envs import adapters
from rbjax.errors import InputError, UnknownName
from tests.envs.adapters.small_task import environment

# Gymnasium advises a range of -1..1 for actions and finite observations, and a registered name.
ADVICE = pytest.mark.filterwarnings("ignore::UserWarning")


@pytest.fixture(scope="module")
def env():
    return environment(episode=30)


@pytest.fixture(scope="module")
def critic_env():
    return environment(critic=True)


@ADVICE
def test_one_environment_passes_the_checker(env):
    check_env(adapters.to_gymnasium(env))


@ADVICE
def test_groups_of_observations_pass_the_checker(critic_env):
    one = adapters.to_gymnasium(critic_env)
    check_env(one)
    assert {name: space.shape for name, space in one.observation_space.items()} == {
        "policy": (4,),
        "critic": (5,),
    }


@ADVICE
@pytest.mark.skipif(np.__version__ < "2.1", reason="Gymnasium's conversion needs NumPy 2.1")
def test_the_functional_environment_passes_the_checker(env):
    """As Gymnasium's own conversion runs it, which draws raw keys."""
    functional = adapters.to_gymnasium_functional(env)
    check_env(FunctionalJaxEnv(functional))


def test_one_environment_runs_the_steps_of_the_task(env):
    one = adapters.to_gymnasium(env)
    obs, info = one.reset(seed=3)
    assert info == {}
    total, length, ended = 0.0, 0, False
    while not ended:
        obs, reward, terminated, truncated, info = one.step(np.zeros(1))
        total, length, ended = total + reward, length + 1, terminated or truncated
        # noise of the angle is at most 0.001
        assert terminated == (abs(float(one.state.state.q[1])) > 0.3)
        assert abs(obs[1] - one.state.state.q[1]) <= 0.001
        assert set(info["rewards"]) == {"upright", "effort"}
    assert truncated == (length == 30)
    np.testing.assert_allclose(total, one.state.episode_return, rtol=1e-12)  # the same sum in f64
    with pytest.raises(InputError, match="reset before"):
        adapters.to_gymnasium(env).step(np.zeros(1))


def _play(envs, steps: int) -> list:
    """Step with forces of -3..3 N, under which some poles fall and some episodes are truncated."""
    obs, _ = envs.reset(seed=0)
    force = np.linspace(-3, 3, envs.num_envs)[:, None]
    path = [(obs, None, None, None, {})] + [envs.step(force) for _ in range(steps)]
    assert any(x[2].any() for x in path[1:]) and any(x[3].any() for x in path[1:])
    return path


def test_a_batch_resets_at_the_next_step(env):
    envs = adapters.to_gymnasium_vector(env, 6)
    assert envs.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    path = _play(envs, 70)
    ends = 0
    for (_, _, terminated, truncated, _), after in itertools.pairwise(path[1:]):
        done = terminated | truncated
        ends += done.sum()
        obs, reward, ended, cut, info = after
        assert obs.dtype == np.float64 and obs.shape == (6, 4)
        assert not (ended | cut)[done].any() and not reward[done].any()
        assert not info["rewards"]["upright"][done].any()
        assert (np.abs(obs[done][:, :2]) < 0.052).all()  # 0.05 of the start, 0.001 of the noise
        assert (reward[~done] > 0).all()
    assert ends > 6  # each environment at least twice


def test_a_batch_resets_at_the_same_step(env):
    envs = adapters.to_gymnasium_vector(env, 6, autoreset="same_step")
    assert envs.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    ends = 0
    for obs, _, terminated, truncated, info in _play(envs, 70)[1:]:
        done = terminated | truncated
        assert ("final_obs" in info) == bool(done.any())
        for i in np.flatnonzero(done):
            ends += 1
            assert info["_final_obs"][i]
            assert (abs(info["final_obs"][i][1]) > 0.299) == terminated[i]
            assert (np.abs(obs[i][:2]) < 0.052).all()
        if done.any():
            assert all(x is None for x in info["final_obs"][~done])
    assert ends > 6


def test_a_batch_that_the_caller_resets(env):
    envs = adapters.to_gymnasium_vector(env, 4, autoreset="disabled")
    envs.reset(seed=0)
    for _ in range(5):
        obs, *_ = envs.step(np.full((4, 1), 5.0))
    mask = np.array([True, False, False, True])
    new, _ = envs.reset(options={"reset_mask": mask})
    np.testing.assert_array_equal(new[~mask], obs[~mask])
    assert (np.abs(new[mask][:, 2:]) < 0.07).all()  # 0.05 of the start, 0.01 of the noise
    assert envs.state.step.tolist() == [0, 5, 5, 0]
    for wrong in (np.ones(3, bool), np.ones(4), np.zeros(4, bool)):
        with pytest.raises(InputError, match="reset_mask"):
            envs.reset(options={"reset_mask": wrong})


def test_a_seed_repeats_a_batch(env):
    envs = adapters.to_gymnasium_vector(env, 3)
    first, second = ([x[0] for x in _play(envs, 40)] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    other, _ = envs.reset(seed=1)
    assert not np.array_equal(other, first[0])


def test_wrappers_of_gymnasium_read_a_batch(env):
    """Returns and lengths of episodes, and info as a list."""
    envs = RecordEpisodeStatistics(adapters.to_gymnasium_vector(env, 4, autoreset="same_step"))
    envs.reset(seed=0)
    found = []
    for _ in range(40):
        *_, info = envs.step(np.zeros((4, 1)))
        if "episode" in info:
            found += [*info["episode"]["l"][info["_episode"]]]
    assert len(found) >= 4 and max(found) <= 30
    listed = DictInfoToList(adapters.to_gymnasium_vector(env, 2))
    listed.reset(seed=0)
    *_, info = listed.step(np.zeros((2, 1)))
    assert [x["failed"] for x in info] == [False, False]
    assert set(info[1]["rewards"]) == {"upright", "effort"}


def test_groups_of_a_batch(critic_env):
    envs = adapters.to_gymnasium_vector(critic_env, 3)
    obs, _ = envs.reset(seed=0)
    assert obs in envs.observation_space
    assert {name: x.shape for name, x in obs.items()} == {"policy": (3, 4), "critic": (3, 5)}


def test_parameters_reach_the_steps(env):
    heavy = env.default_params.replace(weights={"upright": 2.0, "effort": 0.0})
    rewards = []
    for params in (None, heavy):
        envs = adapters.to_gymnasium_vector(env, 2, params)
        envs.reset(seed=0)
        rewards.append(envs.step(np.zeros((2, 1)))[1])
    np.testing.assert_allclose(rewards[1], 2 * rewards[0], rtol=1e-12)


def test_a_state_that_is_not_finite_is_told(env):
    """Its observation is zero, and it ends the episode."""
    envs = adapters.to_gymnasium_vector(env, 2, autoreset="same_step")
    envs.reset(seed=0)
    envs.state = envs.state.replace(state=envs.state.state.replace(v=jnp.full((2, 2), 1e308)))
    obs, reward, terminated, truncated, info = envs.step(np.zeros((2, 1)))
    assert terminated.all() and not truncated.any() and not reward.any()
    assert info["failed"].all() or info["final_info"]["failed"].all()
    assert np.isfinite(obs).all() and not np.array(list(info["final_obs"])).any()


def test_functions_compose_with_vmap_and_jit(env):
    functional = adapters.to_gymnasium_functional(env)
    keys = jax.random.split(jax.random.key(0), 5)
    states = jax.jit(jax.vmap(functional.initial))(keys)
    after = jax.jit(jax.vmap(functional.transition))(states, jnp.zeros((5, 1)), keys)
    obs, _, reward, _, _ = jax.vmap(env.step_once)(keys, states.episode, jnp.zeros((5, 1)))
    np.testing.assert_allclose(functional.observation(after, None), obs, rtol=1e-12)
    np.testing.assert_allclose(functional.reward(None, None, after, None), reward, rtol=1e-12)
    assert not functional.terminal(after, None).any()
    assert functional.default_params is env.default_params


@ADVICE
def test_tasks_have_names():
    """A named environment is made again by the checker, from its specification."""
    names = adapters.register_gymnasium()
    assert adapters.register_gymnasium() == names and len(names) == len(rb.envs.tasks())
    one = gymnasium.make("rbjax/cart_pole_balance-v0")
    check_env(one.unwrapped)
    batch = gymnasium.make_vec("rbjax/cart_pole_balance-v0", num_envs=3, autoreset="same_step")
    assert batch.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    assert batch.reset(seed=0)[0].shape == (3, 5) and batch.spec.id == one.spec.id
    with pytest.raises(UnknownName, match="option"):
        gymnasium.make("rbjax/cart_pole_balance-v0", colour="red")


def test_wrong_arguments_are_told(env):
    with pytest.raises(InputError, match=r"expected an rb\.envs\.Environment"):
        adapters.to_gymnasium(env.task)
    with pytest.raises(InputError, match="num_envs"):
        adapters.to_gymnasium_vector(env, 0)
    with pytest.raises(UnknownName, match="next_step"):
        adapters.to_gymnasium_vector(env, 2, autoreset="later")
    batch = adapters.to_gymnasium_vector(env, 2)
    batch.reset(seed=0)
    for actions in (np.zeros((3, 1)), np.zeros(2), 0.0):
        with pytest.raises(InputError, match=r"actions has shape .* expected \(2, 1\)"):
            batch.step(actions)


@ADVICE
@pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])
def test_a_picture_is_refused(make):
    adapters.register_gymnasium()
    with pytest.raises(InputError, match="render_mode is 'rgb_array', expected None"):
        make("rbjax/cart_pole_balance-v0", render_mode="rgb_array")


def test_the_classes_are_those_of_gymnasium(env):
    assert isinstance(adapters.to_gymnasium(env), gymnasium.Env)
    assert isinstance(adapters.to_gymnasium_vector(env, 1), gymnasium.vector.VectorEnv)
