"""Policies trained through the dynamics: gradients, targets, randomised models, bad input."""

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.control import Environment, actor_critic, network, through_time
from rbjax.control.learning.environment import Segment, squash_controls
from rbjax.control.learning.policy_gradient import (
    Samples,
    draw_batch,
    policy_loss,
    renew_batch,
    returns,
)
from rbjax.control.learning.training import apply_update
from rbjax.errors import InputError, UnknownName
from tests.tolerances import F64_TRANSFORM, relative_error

MODEL = rb.load("cart_pole")
KEY = jax.random.key(0)


def cost(state, ctrl):
    return 1 - jnp.cos(state.q[1]) + 0.1 * (state.v**2).sum() + 1e-3 * (ctrl**2).sum()


def start(key):
    return rb.State(0.3 * jax.random.normal(key, (2,)), jnp.zeros(2))


def heavier(key, model):
    factor = jax.random.uniform(key, (), minval=0.5, maxval=2.0)
    return model.replace(bodies=model.bodies.replace(mass=model.bodies.mass * factor))


def environment(**more):
    return Environment(MODEL, cost, start, **{"dt": 0.05, "episode": 5} | more)


def test_the_gradient_of_the_loss_is_that_of_differences():
    """Through four steps, the squashing, the value function, along three random directions."""
    env = environment()
    policy = network(KEY, (4, 3, 1), last=1.0)
    value = network(jax.random.key(1), (4, 3, 1), "elu", last=1.0)
    _, states = jax.vmap(env.reset)(jax.random.split(KEY, 2))
    flat, shaped = jax.flatten_util.ravel_pytree(policy)

    def loss(theta):
        segment = env.unroll(shaped(theta), None, states, 4)
        last = jax.tree.map(lambda x: x[:, -1], segment.states)
        return policy_loss(segment.costs, jax.vmap(lambda s: value(env.observe(s))[0])(last), 0.9)

    slope = jax.jit(jax.grad(loss))(flat)
    h, ask = 6e-6, jax.jit(loss)
    for direction in np.random.default_rng(0).normal(size=(3, flat.size)):
        change = (ask(flat + h * direction) - ask(flat - h * direction)) / (2 * h)
        assert abs(slope @ direction - change) < 1e-6 * abs(change)


def test_a_batch_of_models_is_a_loop_over_them():
    env = environment(randomise=heavier)
    policy = network(KEY, (4, 3, 1), last=1.0)
    models, states = jax.vmap(env.reset)(jax.random.split(KEY, 3))
    assert len(np.unique(models.bodies.mass[:, 0])) == 3
    segment = jax.jit(lambda m, s: env.unroll(policy, m, s, 2))(models, states)
    for k in range(3):
        model, state = jax.tree.map(lambda x, k=k: x[k], (models, states))
        x, total = state, []
        for i in range(2):
            u = env.act(policy, x)
            assert np.abs(u - segment.ctrl[k, i]).max() < 1e-12
            total.append(cost(x, u))
            x = rb.step(model, x, u, 0.05)
        assert relative_error(segment.states.q[k, -1], x.q) < F64_TRANSFORM
        assert relative_error(segment.costs[k], jnp.stack(total)) < F64_TRANSFORM


def test_targets_are_weighted_sums():
    """l = 1: all costs and the last value; l = 0: one cost and the next value; between: the sum
    over all lengths, Sutton & Barto 12.2."""
    rng = np.random.default_rng(0)
    c, V = rng.normal(size=(2, 4)), rng.normal(size=(2, 4))
    g, h = 0.9, 4

    def length(k, n):  # the return of n steps from k on
        return sum((1 - g) * g**i * c[:, k + i] for i in range(n)) + g**n * V[:, k + n - 1]

    for trace in (0.0, 0.7, 1.0):
        found = returns(jnp.asarray(c), jnp.asarray(V), g, trace)
        for k in range(h):
            most = h - k
            want = trace ** (most - 1) * length(k, most)
            want = want + (1 - trace) * sum(trace ** (n - 1) * length(k, n) for n in range(1, most))
            assert np.abs(found[:, k] - want).max() < 1e-14
    value = policy_loss(jnp.asarray(c), jnp.asarray(V[:, -1]), g)
    assert abs(value - length(0, h).mean()) < 1e-14


def test_controls_stay_in_their_ranges():
    env = environment()
    y = jnp.array([1e3])
    assert squash_controls(env, y)[0] == 20.0 and squash_controls(env, -y)[0] == -20.0
    assert abs(squash_controls(env, jnp.array([0.1]))[0] - 20 * np.tanh(0.1)) < 1e-14
    assert squash_controls(environment(squash=False), y)[0] == 1e3
    free = MODEL.replace(
        actuators=MODEL.actuators.replace(ctrlrange=jnp.array([[-jnp.inf, jnp.inf]]))
    )
    assert squash_controls(Environment(free, cost, start, dt=0.05), y)[0] == 1e3


def test_samples_begin_anew():
    """The old, the lost and those that are not finite; the others go on."""
    env = environment(lost=lambda state: state.q[0] > 9.0, episode=10)
    samples = draw_batch(env, KEY, 4)
    assert samples.models is None and (samples.ages < 10).all()
    q = jnp.zeros((4, 1, 2)).at[1, 0, 0].set(10.0).at[2, 0, 0].set(jnp.nan)
    states = rb.State(q, jnp.full((4, 1, 2), 0.25))
    segment = Segment(states, None, None)
    some = Samples(None, samples.states, jnp.array([8, 0, 0, 3]))
    after = renew_batch(env, KEY, some, segment, 2)
    assert after.ages.tolist() == [0, 0, 0, 5]
    assert np.isfinite(after.states.q).all()
    assert (after.states.v[3] == 0.25).all() and (after.states.v[:3] == 0).all()


def test_a_gradient_that_is_not_finite_changes_nothing():
    import optax

    optimiser = optax.sgd(0.1)
    memory, slope = optimiser.init(jnp.ones(2)), jnp.array([1.0, jnp.nan])
    one, memory, fine = apply_update(optimiser, slope, memory, jnp.ones(2))
    assert (one == 1).all() and not fine
    two, _, fine = apply_update(optimiser, jnp.array([1.0, 2.0]), memory, jnp.ones(2))
    assert np.abs(two - np.array([0.9, 0.8])).max() < 1e-15 and fine


def test_updates_that_are_skipped_are_counted():
    """The slope of the cost is nan: each update is skipped, and the policy stays."""
    env = Environment(MODEL, lambda s, u: jnp.sqrt(s.q[0] - 9.0) + u[0], start, dt=0.05, episode=2)
    policy = network(KEY, (4, 3, 1))
    found = through_time(env, policy, KEY, iterations=2, batch=2)
    assert found.skipped == 2
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), found.policy, policy))


@pytest.mark.slow
def test_gains_come_to_those_of_the_regulator():
    """A mass with a quadratic cost, long episodes: the gains of `lqr`."""
    dt = 0.05
    model = rb.load("tests/oracles/mass_on_a_rail.xml")
    env = Environment(
        model, lambda state, u: (state.q**2).sum() + (state.v**2).sum() + (u**2).sum(),
        lambda key: rb.State(*jax.random.normal(key, (2, 1))), dt=dt, episode=200, squash=False,
    )  # fmt: skip
    gains = jax.tree_util.Partial(jnp.matmul, jnp.array([[-0.5, -0.5]]))
    found = through_time(env, gains, KEY, iterations=600, batch=32, rate=0.05)
    A, B = np.array([[1, dt], [0, 1.0]]), np.array([[dt * dt], [dt]])  # semi-implicit Euler
    want = rb.control.lqr(A, B, dt * np.eye(2), dt * np.eye(1), discrete=True).K
    assert np.abs(found.policy.args[0] - -np.abs(want)).max() < 0.03
    assert found.skipped == 0 and found.value is None


@pytest.mark.slow
def test_a_swing_up_is_learned():
    """A shorter training than the benchmark's."""
    from benchmarks.shared import policy_training as training

    env = training.environment()
    row = training.by_gradients(env, 0, 300, 128)
    assert row["success"] > 0.9 and row["skipped"] == 0


def test_all_runs_once():
    """Both trainers, with progress, in a few steps; the policy moves, its structure stays."""
    env, policy = environment(), network(KEY, (4, 3, 1))
    value = network(KEY, (4, 3, 1), "elu")
    found = actor_critic(env, policy, KEY, value=value, iterations=2, batch=2, horizon=3,
                         value_steps=1)  # fmt: skip
    assert found.costs.shape == (2,) and np.isfinite(found.costs).all() and found.skipped == 0
    assert jax.tree.structure(found.policy) == jax.tree.structure(policy)
    assert np.abs(found.policy.weights[0] - policy.weights[0]).max() > 1e-4
    assert np.abs(found.value.weights[0] - value.weights[0]).max() > 1e-4


def test_a_sample_that_is_lost_does_not_stop_the_value_function():
    """The cost of every other start is nan: the value function learns from the samples that are
    left."""

    def start_of(key):
        return rb.State(jnp.array([jnp.where(jax.random.bernoulli(key), 9.0, 0.1), 0.2]),
                        jnp.zeros(2))  # fmt: skip

    def bad(state, ctrl):
        return jnp.where(state.q[0] > 5.0, jnp.nan, cost(state, ctrl))

    env = Environment(MODEL, bad, start_of, dt=0.05, episode=50)
    policy, value = network(KEY, (4, 3, 1)), network(KEY, (4, 3, 1), "elu")
    found = actor_critic(env, policy, KEY, value=value, iterations=3, batch=6, horizon=2,
                         value_steps=1)  # fmt: skip
    assert np.isfinite(found.costs).all()
    change = np.abs(found.value.weights[0] - value.weights[0])
    assert np.isfinite(change).all() and change.max() > 1e-4


@pytest.mark.parametrize(
    "call, error, said",
    [
        (lambda: environment(episode=0), InputError, "episode is 0"),
        (lambda: environment(dt=-1.0), InputError, "dt is -1"),
        (lambda: Environment(MODEL, lambda s: 0.0, start), InputError, "cost takes"),
        (lambda: Environment(MODEL, lambda s, u: s.q, start), InputError, "cost returned shape"),
        (lambda: Environment(MODEL, cost, lambda key: 1.0), InputError, "start returned"),
        (lambda: Environment(rb.load("pendulum").replace(), cost, start), InputError, "start"),
        (lambda: actor_critic(1, None, KEY), InputError, "env is 1"),
        (lambda: actor_critic(environment(), 3.0, KEY), InputError, "policy is float"),
        (lambda: actor_critic(environment(), network(KEY, (4, 2)), KEY), InputError, "shape"),
        (lambda: actor_critic(environment(), lambda o: o[:1], KEY), InputError, "no floating"),
        (lambda: through_time(environment(), network(KEY, (4, 1)), KEY, batch=0), InputError,
         "batch is 0"),
        (lambda: actor_critic(environment(), network(KEY, (4, 1)), KEY, discount=2.0), InputError,
         "discount is 2"),
        (lambda: network(KEY, (4,)), InputError, "sizes is"),
        (lambda: network(KEY, (4, 1), "relu6"), UnknownName, "activation of network"),
    ],
)  # fmt: skip
def test_bad_input(call, error, said):
    with pytest.raises(error, match=said):
        call()


def test_a_policy_of_equinox():
    """Any callable pytree is one."""
    env = environment()
    policy = eqx.nn.MLP(4, 1, 3, 1, key=KEY)
    env.check_policy("here", policy)
    assert env.act(policy, start(KEY)).shape == (1,)
