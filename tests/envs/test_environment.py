"""`Environment` against a plain loop over `rb.step`, and its edges."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs import Observation, Reward, Task, Variable

MODEL = rb.load("cart_pole")


def start(key, params):
    return rb.State(0.1 * jax.random.normal(key, (2,)), jnp.zeros(2))


def task(**changes):
    fields = {
        "name": "balance",
        "model": MODEL,
        "start": start,
        "observations": {"policy": (Observation("q", lambda to: to.after.q),)},
        "rewards": (
            Reward("upright", lambda to: jnp.cos(to.after.q[1])),
            Reward("effort", lambda to: (to.ctrl**2).sum(), -1e-3),
        ),
        "action": rb.envs.Scaled(),
        "decimation": 2,
        "episode": 5,
    }
    return Task(**(fields | changes))


def heavier(factor):
    return MODEL.replace(bodies=MODEL.bodies.replace(mass=MODEL.bodies.mass * factor))


def states(env, count=3, seed=0):
    return jax.vmap(env.reset)(jax.random.split(jax.random.key(seed), count))


def keys(count, seed=1):
    return jax.random.split(jax.random.key(seed), count)


@pytest.mark.parametrize("kernel", [None, False])
def test_step_is_decimation_physics_steps(kernel):
    env = rb.envs.Environment(task(), kernel=kernel)
    _, state = states(env)
    actions = jnp.array([[0.5], [-0.2], [2.0]])  # the last one is clipped
    obs, after, reward, done, info = jax.vmap(env.step)(keys(3), state, actions)
    ctrl = 20 * jnp.clip(actions, -1, 1)
    path = rb.rollout(MODEL, state.state, jnp.stack([ctrl] * 2, 1))
    np.testing.assert_allclose(after.state.q, path.q[:, -1], atol=1e-14)
    np.testing.assert_allclose(obs, after.state.q, atol=0)
    due = np.cos(path.q[:, -1, 1]) - 1e-3 * ctrl[:, 0] ** 2
    np.testing.assert_allclose(reward, env.dt * due, atol=1e-14)
    assert not done.any() and (info["length"] == 1).all()
    np.testing.assert_allclose(after.ctrl, ctrl, atol=1e-14)


def test_episode_is_truncated_and_begins_again():
    env = rb.envs.Environment(task())
    obs, state = env.reset(jax.random.key(0))
    policy = lambda obs, key: jnp.zeros(1)  # noqa: E731
    obs, state, path = env.unroll(jax.random.key(1), obs, state, policy, 12)
    assert np.flatnonzero(path["truncated"]).tolist() == [4, 9]
    assert not path["terminated"].any() and int(state.step) == 2
    # the observation after the end is the first of the next episode
    assert abs(path["obs"][5] - path["obs"][4]).max() > 1e-3


def test_termination_and_variables():
    count = Variable(
        "count", lambda key, params: jnp.zeros(()), lambda to: to.variables["count"] + 1
    )
    env = rb.envs.Environment(
        task(variables=(count,), terminations={"third": lambda to: to.variables["count"] == 3})
    )
    _, state = env.reset(jax.random.key(0))
    ends = []
    for i in range(4):
        _, state, _, done, info = env.step(jax.random.key(i), state, jnp.zeros(1))
        ends.append(bool(info["terminated"]))
        assert bool(done) == ends[-1]
    assert ends == [False, False, True, False]
    assert float(state.variables["count"]) == 1


def test_noise_delay_and_their_factor():
    terms = (
        Observation("time", lambda to: to.step.astype(float), delay=(2, 2)),
        Observation("noisy", lambda to: jnp.zeros(2), noise=jnp.array([0.5, 0.0])),
    )
    env = rb.envs.Environment(task(observations={"policy": terms}, episode=9))
    obs, state = env.reset(jax.random.key(0))
    seen = [float(obs[0])]
    noise = [float(obs[1])]
    for i in range(4):
        obs, state, *_ = env.step(jax.random.key(i), state, jnp.zeros(1))
        seen.append(float(obs[0]))
        noise.append(float(obs[1]))
        assert obs[2] == 0
    assert seen == [0, 0, 0, 1, 2]
    assert 0 < np.abs(noise).max() <= 0.5
    quiet = env.default_params.replace(noise=0.0)
    assert env.step(jax.random.key(9), state, jnp.zeros(1), quiet)[0][1] == 0


def test_action_delay():
    env = rb.envs.Environment(task(action_delay=(1, 1)))
    _, state = env.reset(jax.random.key(0))
    _, state, *_ = env.step(jax.random.key(0), state, jnp.ones(1))
    assert state.ctrl == 0
    _, state, *_ = env.step(jax.random.key(0), state, jnp.zeros(1))
    assert state.ctrl == 20


@pytest.mark.parametrize("kernel", [None, False])
def test_randomisation_holds_for_an_episode(kernel):
    masses = rb.envs.random_scale("masses", lambda model: model.bodies.mass, 0.5, 2.0)
    env = rb.envs.Environment(task(randomise=(masses,)), kernel=kernel)
    _, state = states(env)
    assert len(set(np.asarray(state.drawn["masses"]).tolist())) == 3
    _, after, *_ = jax.vmap(env.step)(keys(3), state, jnp.ones((3, 1)))
    for i in range(3):
        model = MODEL.replace(
            bodies=MODEL.bodies.replace(mass=MODEL.bodies.mass * state.drawn["masses"][i])
        )
        one = jax.tree.map(lambda x: x[i], state.state)  # noqa: B023
        path = rb.rollout(model, one, jnp.full((2, 1), 20.0))
        np.testing.assert_allclose(after.state.q[i], path.q[-1], atol=1e-13)


def test_params_are_arguments():
    env = rb.envs.Environment(task())
    _, state = env.reset(jax.random.key(0))
    params = env.default_params
    heavy = params.replace(model=MODEL.replace(gravity=2 * MODEL.gravity))
    batch = jax.tree.map(lambda a, b: jnp.stack([a, b]), params, heavy)
    step = jax.vmap(env.step, in_axes=(None, None, None, 0))
    _, after, *_ = step(jax.random.key(0), state, jnp.zeros(1), batch)
    for i, given in enumerate((params, heavy)):
        path = rb.rollout(given.model, state.state, jnp.zeros((2, 1)))
        np.testing.assert_allclose(after.state.v[i], path.v[-1], atol=1e-14)
    doubled = params.replace(weights={name: 2 * w for name, w in params.weights.items()})
    rewards = [
        float(env.step(jax.random.key(0), state, jnp.ones(1), p)[2]) for p in (params, doubled)
    ]
    assert rewards[1] == pytest.approx(2 * rewards[0])


def test_gradient_of_a_return():
    env = rb.envs.Environment(task())
    _, state = states(env)

    def total(actions):  # (3, 4, 1)
        def one(state, action):
            _, state, reward, *_ = jax.vmap(env.step_once)(keys(3), state, action)
            return state, reward

        return jax.lax.scan(one, state, actions.swapaxes(0, 1))[1].sum()

    actions = 0.3 * jax.random.normal(jax.random.key(2), (3, 4, 1))
    found = jax.jit(jax.grad(total))(actions)
    h = 1e-6
    e = jnp.zeros_like(actions).at[1, 2, 0].set(h)
    due = (total(actions + e) - total(actions - e)) / (2 * h)
    np.testing.assert_allclose(found[1, 2, 0], due, rtol=1e-6)


def test_state_that_is_not_finite_ends_the_episode():
    env = rb.envs.Environment(task())
    _, state = env.reset(jax.random.key(0))
    obs, state, reward, done, info = env.step(jax.random.key(0), state, jnp.full(1, jnp.nan))
    assert done and info["failed"] and info["terminated"] and not info["truncated"]
    assert reward == 0 and all(r == 0 for r in info["rewards"].values())
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves((obs, state)))


def test_groups_of_observations_and_sensors():
    arm = rb.load("arm7")
    sensed = Observation("gyro", "gyro:tool")
    groups = {"policy": (sensed,), "critic": (sensed, Observation("q", lambda to: to.after.q))}
    env = rb.envs.Environment(
        task(
            model=arm, start=lambda key, params: arm.random_state(key), observations=groups,
            rewards=(Reward("alive", lambda to: 1.0),),
        )
    )  # fmt: skip
    assert env.observation_size == {"policy": 3, "critic": 3 + arm.nq}
    obs, state = env.reset(jax.random.key(0))
    sensor = rb.sensors.NamedSensor("gyro", rb.sensors.Gyro("tool"))
    due = rb.sense(arm.replace(sensors=(sensor,)), state.state)
    np.testing.assert_allclose(obs["policy"], due, atol=1e-14)


def test_float32():
    with jax.enable_x64(False):
        env = rb.envs.Environment(task(model=rb.load("cart_pole")))
        obs, state = env.reset(jax.random.key(0))
        obs, state, reward, *_ = env.step(jax.random.key(0), state, jnp.zeros(1))
        assert {x.dtype for x in (obs, reward, state.state.q, state.acceleration)} == {
            jnp.dtype("float32")
        }


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rewards": (Reward("v", lambda to: to.after.v),)}, "'v' returned shape (2,)"),
        ({"rewards": ()}, "rewards is empty"),
        ({"rewards": (Reward("a", lambda to: 1.0),) * 2}, "has 'a' twice"),
        ({"observations": {}}, '"policy"'),
        ({"observations": {"policy": (Observation("x", "gyro:nowhere"),)}}, "nowhere"),
        ({"observations": {"policy": (Observation("x", "nothing"),)}}, "sensor kind"),
        ({"observations": {"policy": (Observation("x", lambda to: jnp.zeros((2, 2))),)}}, "(2, 2)"),
        ({"observations": {"policy": (Observation("x", lambda to: 1.0, delay=(2, 1)),)}}, "(2, 1)"),
        ({"start": lambda key, params: rb.State(jnp.zeros(3), jnp.zeros(2))}, "start returned"),
        ({"terminations": {"t": lambda to: to.after.v > 0}}, "termination 't' returned shape"),
        ({"decimation": 0}, "decimation"),
        ({"dt": 0.0}, "dt"),
        ({"terminations": {"t": lambda to: to.step}}, "expected a bool"),
        ({"observations": {"policy": ()}}, "is empty"),
        ({"observations": {"policy": (Observation("x", lambda to: 1.0, delay=1),)}}, "delay"),
        ({"observations": {"policy": (Observation("x", lambda to: 1.0, noise=[1, 2]),)}}, "(2,)"),
        ({"action": rb.envs.Offset((0.0, 0.0))}, "rest has shape (2,)"),
        ({"action": rb.envs.Increment(1.0, (0.0, 0.0))}, "start has shape (2,)"),
        ({"values": {"a": "word"}}, "'word'"),
        ({"episode": 0}, "episode"),
    ],
)  # fmt: skip
def test_wrong_tasks_say_what_is_wrong(changes, words):
    with pytest.raises(rb.RbjaxError) as error:
        rb.envs.Environment(task(**changes))
    assert words in str(error.value)


def test_wrong_arguments():
    env = rb.envs.Environment(task())
    _, state = env.reset(jax.random.key(0))
    with pytest.raises(rb.InputError, match=r"action has shape \(2,\), expected \(1,\)"):
        env.step(jax.random.key(0), state, jnp.zeros(2))
    with pytest.raises(rb.InputError, match="expected a key"):
        env.reset(0)
    with pytest.raises(rb.InputError, match="batch of keys"):
        env.reset(keys(3))
    params = env.default_params
    with pytest.raises(rb.InputError, match="weights"):
        env.reset(jax.random.key(0), params.replace(weights={}))
    with pytest.raises(rb.InputError, match=r"expected rb\.envs\.Params"):
        env.reset(jax.random.key(0), {})
    with pytest.raises(rb.InputError, match="the model of the task"):
        env.reset(jax.random.key(0), params.replace(model=rb.load("pendulum")))
    with pytest.raises(rb.UnknownName, match="no_such_task"):
        rb.envs.make("no_such_task")
    with pytest.raises(rb.InputError, match=r"the action of the policy has shape \(\)"):
        env.unroll(jax.random.key(0), jnp.zeros(2), state, lambda obs, key: 0.0, 2)
    for obs, words in ((jnp.zeros(3), r"obs has shape \(3,\)"), (None, "obs is None")):
        with pytest.raises(rb.InputError, match=words):
            env.unroll(jax.random.key(0), obs, state, lambda obs, key: jnp.zeros(1), 2)
    for horizon in (0, 1.5, None):
        with pytest.raises(rb.InputError, match="problem: horizon is"):
            env.problem(horizon)


def test_batch_on_a_mesh_of_explicit_axes():
    mesh = jax.make_mesh((1,), ("batch",), axis_types=(jax.sharding.AxisType.Explicit,))
    env = rb.envs.Environment(task())
    _, state = states(env, 4)
    spread = jax.sharding.NamedSharding(mesh, jax.sharding.PartitionSpec("batch"))
    given = keys(4), state, jnp.ones((4, 1))
    due = jax.vmap(env.step)(*given)
    with jax.set_mesh(mesh):
        found = jax.jit(jax.vmap(env.step))(*jax.device_put(given, spread))
    np.testing.assert_array_equal(found[0], due[0])


def test_a_step_is_traced_once_for_all_programs():
    count = []

    def counted(to):
        count.append(0)
        return to.after.q

    env = rb.envs.Environment(task(observations={"policy": (Observation("q", counted),)}))
    _, state = states(env)
    given = keys(3), state, jnp.zeros((3, 1))
    due = jax.jit(jax.vmap(env.step))(*given)
    before = len(count)
    found = jax.jit(lambda *given: jax.vmap(env.step)(*given))(*given)  # another program
    assert len(count) == before
    np.testing.assert_array_equal(found[0], due[0])
    changed = env.default_params.replace(noise=jnp.ones(()) * 2)
    assert jax.jit(lambda *given: jax.vmap(env.step, (0, 0, 0, None))(*given, changed))(*given)
    assert len(count) > before  # other constants are another program


@pytest.mark.parametrize("kernel", [None, False])
def test_observations_read_the_step_before(kernel):
    terms = (
        Observation("actions", lambda to: jnp.concatenate([to.action, to.last_action])),
        Observation("change", lambda to: to.after.q - to.before.q),
        Observation("controls", lambda to: jnp.concatenate([to.ctrl, to.last_ctrl])),
    )
    env = rb.envs.Environment(task(observations={"policy": terms}, episode=2), kernel=kernel)
    obs, state = env.reset(jax.random.key(0))
    assert not obs.any()
    q = state.state.q
    obs, state, *_ = env.step(jax.random.key(1), state, jnp.ones(1))
    np.testing.assert_array_equal(obs[:2], [1, 0])
    np.testing.assert_allclose(obs[2:4], state.state.q - q, atol=1e-15)
    np.testing.assert_array_equal(obs[4:], [20, 0])
    once, *_ = env.step_once(jax.random.key(2), state, -jnp.ones(1))
    np.testing.assert_array_equal(once[:2], [-1, 1])
    np.testing.assert_array_equal(once[4:], [-20, 20])
    obs, state, _, done, _ = env.step(jax.random.key(2), state, -jnp.ones(1))
    assert done and not obs.any()  # the first observation of the next episode


def test_a_reward_that_is_not_finite_ends_the_episode():
    bad = Reward("root", lambda to: jnp.sqrt(-1 - to.after.q[0] ** 2))
    env = rb.envs.Environment(task(rewards=(bad,)))
    _, state = env.reset(jax.random.key(0))
    *_, reward, done, info = env.step(jax.random.key(0), state, jnp.zeros(1))
    assert reward == 0 and done and info["failed"] and info["terminated"]
    assert done.dtype == bool


def test_randomised_entries_share_a_factor_or_not():
    low, high = jnp.array([1.0, 2.0]), jnp.array([2.0, 4.0])
    for each in (False, True):
        draw = rb.envs.random_scale("m", lambda m: m.bodies.mass, low, high, each=each).draw
        env = rb.envs.Environment(task())
        values = jax.vmap(lambda key: draw(key, env.default_params))(keys(50))  # noqa: B023
        share = (values - low) / (high - low)
        assert (np.abs(share[:, 0] - share[:, 1]).max() < 1e-12) == (not each)
        assert values.min() >= 1 and (values <= high).all()


def test_time_steps_and_values():
    env = rb.envs.Environment(task(dt=0.004, decimation=5, values={"count": 3, "on": True}))
    assert env.dt == 0.004 * 5
    values = env.default_params.values
    assert values["count"].dtype == env.dtype and values["on"].dtype == bool


def test_the_cache_of_programs_is_bounded(monkeypatch):
    """Each new constant is a new program; a cache keeps the last ones."""
    from rbjax.dynamics.tracing import one_sample

    monkeypatch.setattr(one_sample, "MOST_PROGRAMS", 2)
    cache = {}
    for k in range(4):
        constant = jnp.asarray(float(k))

        def product(x, constant=constant):
            return one_sample.run_sample(lambda x, c: x * c, x, constant, cache=cache)

        assert (jax.vmap(product)(jnp.ones(3)) == k).all()
        assert len(cache) == min(k + 1, 2)
