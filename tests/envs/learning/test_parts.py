"""Parts of the learners: targets, statistics, policies, updates, settings, networks."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

import rbjax as rb
from rbjax.envs.actions import action_center_and_scale
from rbjax.envs.learning import Policy, network, new_policy
from rbjax.envs.learning.iterations import SAME, run_iterations
from rbjax.envs.learning.networks import LEAST_STD, normaliser
from rbjax.envs.learning.targets import objective, value_targets
from rbjax.envs.learning.task_settings import ALGORITHMS, PPO, settings
from rbjax.envs.learning.training import shac_arguments
from rbjax.envs.learning.updates import apply_update
from tests.envs.learning.pole import KEY, environment


def test_targets_are_weighted_sums():
    """l = 1: all rewards and the last value; l = 0: one reward and the next value; between: the
    sum over all lengths, Sutton & Barto 12.2."""
    rng = np.random.default_rng(0)
    r, V = rng.normal(size=(4, 2)), rng.normal(size=(4, 2))
    g, h, never = 0.9, 4, np.zeros((4, 2), bool)

    def length(k, n):  # the return of n steps from k on
        return sum((1 - g) * g**i * r[k + i] for i in range(n)) + g**n * V[k + n - 1]

    for trace in (0.0, 0.7, 1.0):
        found = value_targets(*map(jnp.asarray, (r, V, never, never)), g, trace)
        for k in range(h):
            most = h - k
            want = trace ** (most - 1) * length(k, most)
            want = want + (1 - trace) * sum(trace ** (n - 1) * length(k, n) for n in range(1, most))
            assert np.abs(found[k] - want).max() < 1e-14
    J = objective(*map(jnp.asarray, (r, V, never, never)), g)
    assert np.abs(J - length(0, h)).max() < 1e-14


def test_an_episode_that_ends_is_cut():
    """The first sample is truncated after its second step, the second one terminates there: each
    part has a return of its own, with a last value or without."""
    rng = np.random.default_rng(1)
    r, V = rng.normal(size=(4, 2)), rng.normal(size=(4, 2))
    done = np.zeros((4, 2), bool)
    done[1] = True
    ended = done & [False, True]
    g = 0.9

    def part(k, n, k_sample, last):
        return (
            sum((1 - g) * g**i * r[k + i, k_sample] for i in range(n))
            + last * g**n * (V[k + n - 1, k_sample])
        )

    J = objective(*map(jnp.asarray, (r, V, done, ended)), g)
    G = value_targets(*map(jnp.asarray, (r, V, done, ended)), g, 1.0)
    for sample, last in ((0, 1), (1, 0)):
        first, second = part(0, 2, sample, last), part(2, 2, sample, 1)
        assert abs(J[sample] - first - second) < 1e-14
        assert abs(G[0, sample] - first) < 1e-14 and abs(G[2, sample] - second) < 1e-14


def test_running_statistics_are_those_of_all_observations():
    """In three parts, the last of which two devices share; values that are not finite are zero
    deviations."""
    x = np.random.default_rng(0).normal(3.0, 2.0, (30, 2)) * [1.0, 1e-8]
    now = normaliser(2)
    for part in (x[:4], x[4:10].reshape(2, 3, 2)):
        now = now.include(jnp.asarray(part))
    halves = jnp.asarray(x[10:].reshape(2, 10, 2))

    def share(half):
        mean = lambda value: jax.tree.map(lambda v: jax.lax.pmean(v, "d"), value)  # noqa: E731
        return now.include(half, mean, 2)

    now = jax.tree.map(lambda v: v[0], jax.vmap(share, axis_name="d")(halves))
    assert np.abs(now.mean - x.mean(0)).max() < 1e-14 and now.count == 30
    assert abs(now.std[0] - x[:, 0].std()) < 1e-14 and now.std[1] == LEAST_STD
    assert np.abs(now(now.mean + 3 * now.std) - 3.0).max() < 1e-12
    assert (now(now.mean + 1e6) == 10.0).all()


def test_statistics_keep_their_dtype():
    """A policy that was trained in f32 sees observations in f64."""
    before = jax.tree.map(lambda x: x.astype(jnp.float32), normaliser(2))
    after = before.include(jnp.ones((3, 2), jnp.float64))
    assert [x.dtype for x in jax.tree.leaves(after)] == [jnp.float32] * 3


def test_statistics_of_one_observation_and_of_huge_ones():
    """One observation has no deviation: it stays 1. A huge entry counts as the mean."""
    one = normaliser(1).include(jnp.array([[5.0]]))
    assert one.mean == 5.0 and one.std == 1.0 and one.count == 1
    two = one.include(jnp.array([[9.0]]))
    assert two.mean == 7.0 and abs(two.std - 2.0) < 1e-15
    more = two.include(jnp.array([[jnp.nan], [1e7]]))
    assert more.mean == 7.0 and abs(more.std - 2.0**0.5) < 1e-15 and more.count == 4


def test_a_training_has_a_shorter_last_chunk():
    """7 iterations in at most 3 programs: 3, 3 and 1."""
    seen = []
    last, figures = run_iterations(
        lambda x, k: (x + k, {"k": k}), lambda: jnp.asarray(0), (), 7, layout=SAME,
        devices=jax.devices()[:1], chunks=3,
        report=lambda done, state, rows: seen.append((done, int(state), len(rows["k"]))),
    )  # fmt: skip
    assert seen == [(3, 3, 3), (6, 15, 3), (7, 21, 1)]
    assert last == 21 and figures["k"].tolist() == list(range(7))


def test_center_and_scale_of_an_action_without_limits():
    low, high = jnp.array([2.0, -jnp.inf, 0.0]), jnp.array([6.0, jnp.inf, jnp.inf])
    limited, center, scale = action_center_and_scale(low, high)
    assert limited.tolist() == [True, False, False]
    assert center.tolist() == [4, 0, 0] and scale.tolist() == [2, 1, 1]


def test_actions_stay_in_their_range():
    env = environment()
    policy = new_policy(env, KEY, (3,), normalise=False, std=None)
    for y, want in ((1e3, 20.0), (-1e3, -20.0), (0.1, 20 * np.tanh(0.1))):
        shifted = policy.replace(network=lambda x, y=y: jnp.array([y]))
        assert abs(shifted(jnp.zeros(4)) - want) < 1e-14
    free = Policy(lambda x: jnp.array([7.0]), None, None, -jnp.full(1, jnp.inf), jnp.ones(1))
    assert free(jnp.zeros(4)) == 7.0


def test_noise_of_a_policy():
    """Its own standard deviation, or the second half of the network's output."""
    keys = jax.random.split(KEY, 4000)
    wide = jnp.full(1, jnp.inf)
    one = Policy(lambda x: x[:1], None, jnp.log(jnp.array([0.5])), -wide, wide)
    two = Policy(lambda x: x[:2], None, None, -wide, wide)
    obs = jnp.array([3.0, jnp.log(jnp.expm1(0.5))])
    for policy in (one, two):
        y = jax.vmap(lambda key, policy=policy: policy({"policy": obs}, key))(keys)
        assert abs(y.mean() - 3.0) < 0.04 and abs(y.std() - 0.5) < 0.03  # 4 standard errors
        assert policy(obs) == 3.0


def test_a_gradient_that_is_not_finite_changes_nothing():
    optimiser = optax.sgd(0.1)
    memory, slope = optimiser.init(jnp.ones(2)), jnp.array([1.0, jnp.nan])
    one, memory, fine = apply_update(optimiser, slope, memory, jnp.ones(2))
    assert (one == 1).all() and not fine
    two, _, fine = apply_update(optimiser, jnp.array([1.0, 2.0]), memory, jnp.ones(2))
    assert np.abs(two - np.array([0.9, 0.8])).max() < 1e-15 and fine


def test_a_network_is_linear_behind_its_last_layer():
    """tanh of the hidden layer only; weights of variance 2 / in, the last ones a hundredth."""
    net = network(jax.random.key(0), (200, 100, 20))
    for W, due in zip(net.weights, [(2 / 200) ** 0.5, 0.01 * (2 / 100) ** 0.5], strict=True):
        np.testing.assert_allclose(np.std(W), due, rtol=0.05)
    assert all((np.asarray(b) == 0).all() for b in net.biases)
    x = np.random.default_rng(0).normal(size=200)
    first, last = (np.asarray(W, float) for W in net.weights)
    np.testing.assert_allclose(net(x), last @ np.tanh(first @ x), rtol=0, atol=1e-6)


def test_settings_fit_the_learners():
    """Every setting is an argument of its learner; Brax needs a multiple of the samples."""
    import inspect

    from rbjax.envs.learning import shac

    for task in (*rb.envs.tasks(), None):
        for backend in ("cpu", "gpu"):
            found = settings(task, "ppo", backend)
            batch = found["batch_size"] * found["num_minibatches"]
            assert batch % found["num_envs"] == 0 and set(found) <= set(PPO) | {"clipping_epsilon"}
            found = shac_arguments(settings(task, "shac", backend))
            assert set(found) <= set(inspect.signature(shac).parameters)
    for task in (*rb.envs.tasks(), None):  # a CPU has few samples
        assert settings(task, "ppo", "cpu")["num_envs"] == 64
        if task in ("go1_joystick_smooth", "hopper_run"):  # have measured settings of a CPU
            assert settings(task, "shac", "cpu")["batch"] == 64
            continue
        on_gpu, on_cpu = (settings(task, "shac", backend) for backend in ("gpu", "cpu"))
        iterations = [x["steps"] // x["batch"] // x["horizon"] for x in (on_gpu, on_cpu)]
        assert on_cpu["batch"] == 128 <= on_gpu["batch"] and iterations[0] == iterations[1]
    assert ALGORITHMS == ("ppo", "shac")
