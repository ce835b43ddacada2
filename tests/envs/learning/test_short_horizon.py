"""SHAC and back-propagation through time: gradients, samples, training, bad input."""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs import Observation, Reward
from rbjax.envs.learning import network, new_critic, new_policy, shac, through_time
from rbjax.envs.learning.samples import Samples, draw_samples, limit_gradient, move_samples
from rbjax.envs.learning.targets import objective
from tests.envs.learning.pole import KEY, environment, observe, start
from tests.tolerances import F64_TRANSFORM, relative_error


def test_the_gradient_of_the_objective_is_that_of_differences():
    """Through four steps with noise, the end of an episode in their middle, squashing, and the
    value function, along three random directions."""
    env = environment()
    policy = new_policy(env, KEY, (3,), std=0.3)
    policy = policy.replace(network=network(KEY, (4, 3, 1), last=1.0))
    critic = new_critic(env, KEY, (3,))
    samples = draw_samples(env, KEY, 2, env.default_params)
    state = samples.state.replace(step=jnp.asarray([0, 3], jnp.int32))  # the second ends in 2 steps
    samples = samples._replace(state=state)
    flat, shaped = jax.flatten_util.ravel_pytree((policy.network, policy.log_std))

    def J(theta):
        net, noise = shaped(theta)
        acting = policy.replace(network=net, log_std=noise)
        _, path = move_samples(env, acting, samples, KEY, 4, env.default_params)
        values = jax.vmap(jax.vmap(critic))(path.seen)
        return objective(path.rewards, values, path.done, path.ended, 0.9).mean(), path.done

    (_, done), slope = jax.jit(jax.value_and_grad(J, has_aux=True))(flat)
    assert done.sum() == 1 and done[1, 1]
    h, ask = 6e-6, jax.jit(lambda theta: J(theta)[0])
    for direction in np.random.default_rng(0).normal(size=(3, flat.size)):
        change = (ask(flat + h * direction) - ask(flat - h * direction)) / (2 * h)
        assert abs(slope @ direction - change) < 1e-6 * abs(change)


def test_a_batch_is_a_loop_over_its_samples():
    """Two samples of three steps, one of which begins again after the first."""
    env = environment()
    policy = new_policy(env, KEY, (3,), std=None)
    first = draw_samples(env, KEY, 2, None)
    first = first._replace(state=first.state.replace(step=jnp.asarray([0, 4], jnp.int32)))
    after, path = jax.jit(lambda s: move_samples(env, policy, s, KEY, 3, None))(first)
    assert path.done.T.tolist() == [[False] * 3, [True, False, False]]
    for k in range(2):
        obs, state = jax.tree.map(lambda x, k=k: x[k], (first.obs, first.state))
        for i in range(3):
            assert relative_error(path.obs[i, k], obs) < F64_TRANSFORM
            seen, state, reward, done, _ = env.step_once(KEY, state, policy(obs))
            assert relative_error(path.seen[i, k], seen) < F64_TRANSFORM
            assert relative_error(path.rewards[i, k], reward) < F64_TRANSFORM
            obs = path.obs[i + 1, k] if i < 2 else None
            if done:  # the new start is read from the batch
                state = state.replace(
                    state=rb.State(obs[:2], obs[2:]), step=jnp.zeros_like(state.step)
                )
            else:
                assert obs is None or relative_error(obs, seen) < F64_TRANSFORM
    assert after.state.step.tolist() == [3, 2]
    assert after.whole.tolist() == [bool(first.whole[0]), True]


def test_the_slope_of_a_sample_that_is_not_finite_is_zero():
    def f(x):
        x = limit_gradient({"a": x, "n": jnp.zeros(2, int)}, None)["a"]
        return (x * jnp.array([[2.0], [jnp.inf]])).sum()

    slope = jax.grad(f)(jnp.ones((2, 1)))
    assert slope.tolist() == [[2.0], [0.0]]


def test_the_slope_of_a_sample_is_limited():
    """To 1 / 2 in a batch of two, over all arrays of the sample; a smaller one stays."""

    def f(a, b):
        a, b = limit_gradient((a, b), 1.0)
        return (a @ jnp.array([[3.0, 0.1], [4.0, 0.2]])).trace() + b @ jnp.array([12.0, 0.3])

    a, b = jax.grad(f, (0, 1))(jnp.ones((2, 2)), jnp.ones(2))
    assert np.abs(a - np.array([[3 / 26, 4 / 26], [0.1, 0.2]])).max() < 1e-15
    assert np.abs(b - np.array([12 / 26, 0.3])).max() < 1e-15


def test_all_runs_once():
    """A training with reports: the policy moves, its structure and its range stay."""
    env = environment()
    policy, critic = new_policy(env, KEY, (3,)), new_critic(env, KEY, (3,))
    seen = []
    found = shac(
        env, KEY, policy, critic=critic, iterations=4, batch=2, horizon=3, critic_steps=1,
        reports=2, report=lambda *args: seen.append(args),
    )  # fmt: skip
    assert found.rewards.shape == (4,) and np.isfinite(found.rewards).all() and found.skipped == 0
    assert jax.tree.structure(found.policy) == jax.tree.structure(policy)
    assert np.abs(found.policy.network.weights[0] - policy.network.weights[0]).max() > 1e-4
    assert np.abs(found.critic.network.weights[0] - critic.network.weights[0]).max() > 1e-4
    assert (found.policy.low == policy.low).all() and found.policy.log_std != policy.log_std
    assert found.policy.normaliser.count == 2 + 4 * 2 * 3
    assert [steps for steps, *_ in seen] == [12, 24]
    assert seen[1][2].network.sizes == (4, 3, 1)


def test_warming_up_changes_the_critic_only():
    env = environment()
    policy, critic = new_policy(env, KEY, (3,)), new_critic(env, KEY, (3,))
    seen = []
    found = shac(
        env, KEY, policy, critic=critic, iterations=3, batch=2, horizon=2, warm_up=2, reports=3,
        report=lambda steps, figures, policy: seen.append(policy.network.weights[0]),
    )  # fmt: skip
    assert (seen[1] == policy.network.weights[0]).all()
    assert np.abs(seen[2] - seen[1]).max() > 1e-4
    assert np.abs(found.critic.network.weights[0] - critic.network.weights[0]).max() > 1e-4


def test_a_sample_that_fails_does_not_stop_the_training():
    """Every other episode begins with a state whose next one is not finite."""

    def some(key, params):
        bad = jax.random.bernoulli(key)
        return rb.State(jnp.array([0.1, 0.2]), jnp.where(bad, 1e200, jnp.zeros(2)))

    env = environment(start=some)
    policy, critic = new_policy(env, KEY, (3,)), new_critic(env, KEY, (3,))
    rows = []
    found = shac(
        env, KEY, policy, critic=critic, iterations=3, batch=6, horizon=2, critic_steps=1,
        report=lambda steps, figures, policy: rows.append(figures),
    )  # fmt: skip
    assert rows[0]["failed"] > 0 and found.skipped == 0
    for new, old in ((found.policy, policy), (found.critic, critic)):
        change = np.abs(new.network.weights[0] - old.network.weights[0])
        assert np.isfinite(change).all() and change.max() > 1e-4
    assert np.isfinite(found.policy.normaliser.mean).all()


def test_updates_that_are_skipped_are_counted():
    """The slope of the reward is NaN for the gains: each update is skipped, the policy stays."""

    class Odd(eqx.Module):
        gain: jax.Array

        def __call__(self, obs):
            return jnp.sqrt(self.gain) * obs[:1]

    env = environment(episode=2)
    with pytest.warns(UserWarning, match="2 of 2 updates were skipped, because their gradients"):
        found = through_time(env, Odd(jnp.asarray(0.0)), KEY, iterations=2, batch=2)
    assert found.skipped == 2 and found.policy.network.gain == 0


def test_a_critic_reads_its_own_observations():
    groups = {"policy": (Observation("q", lambda to: to.after.q),),
              "critic": (Observation("state", observe),)}  # fmt: skip
    env = environment(observations=groups)
    found = shac(env, KEY, iterations=1, batch=2, horizon=2, hidden=(3,))
    assert found.policy.network.sizes == (2, 3, 1) and found.critic.network.sizes == (4, 3, 1)


def test_a_curriculum_changes_the_parameters_over_the_training():
    """The weight of the only reward is the progress."""

    def curriculum(params, progress):
        return params.replace(weights={"one": jnp.asarray(progress, float)})

    env = environment(rewards=(Reward("one", lambda to: 1.0),), curriculum=curriculum)
    found = [
        shac(env, KEY, iterations=4, batch=2, horizon=2, hidden=(3,)).rewards,
        through_time(env, network(KEY, (4, 1)), KEY, iterations=4, batch=2).rewards,
    ]
    assert np.abs(found - np.array([0.0, 0.25, 0.5, 0.75])).max() < 1e-15


def test_a_policy_of_equinox():
    """Any callable pytree gives the actions as they are."""
    env = environment()
    policy = eqx.nn.MLP(4, 1, 3, 1, key=KEY)
    found = shac(env, KEY, policy, iterations=1, batch=2, horizon=2)
    obs, _ = env.reset(KEY)
    assert found.policy.normaliser is None
    assert (found.policy(obs) == found.policy.network(obs)).all()


@pytest.mark.slow
def test_gains_come_to_those_of_the_regulator():
    """A mass with a quadratic cost, long episodes: the gains of `lqr`."""
    dt = 0.05

    def cost(to):
        return -((to.before.q**2).sum() + (to.before.v**2).sum() + (to.ctrl**2).sum())

    task = rb.envs.Task(
        "mass", rb.load("tests/oracles/mass_on_a_rail.xml"),
        lambda key, params: rb.State(*jax.random.normal(key, (2, 1))),
        {"policy": (Observation("state", observe),)}, (Reward("cost", cost),), dt=dt, episode=200,
    )  # fmt: skip
    gains = jax.tree_util.Partial(jnp.matmul, jnp.array([[-0.5, -0.5]]))
    env = rb.envs.Environment(task)
    found = through_time(env, gains, KEY, iterations=600, batch=32, rate=0.05)
    A, B = np.array([[1, dt], [0, 1.0]]), np.array([[dt * dt], [dt]])  # semi-implicit Euler
    want = rb.control.lqr(A, B, dt * np.eye(2), dt * np.eye(1), discrete=True).K
    assert np.abs(found.policy.network.args[0] - -np.abs(want)).max() < 0.03
    assert found.skipped == 0 and found.critic is None


@pytest.mark.slow
def test_a_swing_up_is_learned():
    """A shorter training than the benchmark's."""
    from benchmarks.shared import policy_training as training

    row = training.by_gradients(training.environment(), 0, 300, 128)
    assert row["success"] > 0.9 and row["skipped"] == 0


def test_samples_are_a_pytree_of_arrays():
    env = environment()
    samples = draw_samples(env, KEY, 4, None)
    assert isinstance(samples, Samples) and (samples.state.step < 5).all()
    assert samples.whole.tolist() == (samples.state.step == 0).tolist()
    assert start(KEY, None).q.shape == (2,)
