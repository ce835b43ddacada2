"""Observations of an environment as sensors of `rb.sysid`: a parameter is found from a log."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs import Observation


def log(env, steps, seed, params=None):
    """A log of random actions, from a reset."""
    obs, state = env.reset(jax.random.key(seed), params)
    policy = lambda obs, key: jax.random.uniform(key, (1,), minval=-1, maxval=1)  # noqa: E731
    _, _, path = env.unroll(jax.random.key(seed + 1), obs, state, policy, steps, params)
    assert not np.asarray(path["done"]).any()
    return path, state


def noisy_cart_pole(noise):
    task = rb.envs.tasks()["cart_pole_balance"]()
    terms = task.observations["policy"]
    terms = [dataclasses.replace(t, noise=noise) for t in terms]
    return rb.envs.Environment(dataclasses.replace(task, observations={"policy": terms}))


def test_sensors_are_the_observations():
    env = rb.envs.make("damp_flexible_arm", randomise=False)
    params = env.default_params.replace(noise=0.0)
    path, state = log(env, 20, 0, params)
    sensors = rb.envs.observation_sensors(env)
    assert sorted(sensors) == ["other:rate", "other:strain"]  # no goal, no action
    goal = float(state.variables["goal"])
    sensors = rb.envs.observation_sensors(env, variables={"goal": goal})
    assert sorted(sensors) == ["other:goal_error", "other:rate", "other:strain"]
    model = env.task.model
    for row in np.asarray(path["obs"]["critic"])[:5]:
        q = np.concatenate([row[:1] + goal, row[5:8]])
        v = np.concatenate([row[1:2], row[8:11]])
        context = rb.forces.Context.of(model, 0.0, rb.State(jnp.asarray(q), jnp.asarray(v)), None)
        np.testing.assert_allclose(sensors["other:strain"](context), row[2:4], atol=1e-12)
        np.testing.assert_allclose(sensors["other:goal_error"](context), row[:1], atol=1e-12)


def test_recording_has_the_log():
    env = noisy_cart_pole(0.03)
    path, state = log(env, 30, 0)
    recording = rb.envs.log_recording(env, path["obs"], path["action"], start=state.state)
    obs = np.asarray(path["obs"])
    values = {"cart_position": obs[:, :1], "pole_direction": obs[:, 1:3], "velocity": obs[:, 3:]}
    for name, due in values.items():
        channel = recording.channels[f"other:{name}"]
        np.testing.assert_allclose(channel.values, due)
        np.testing.assert_allclose(channel.noise, 0.03 / np.sqrt(3))
        np.testing.assert_allclose(channel.t, 0.01 * np.arange(30), atol=1e-9)
    ctrl = recording.channels["ctrl"].values
    np.testing.assert_allclose(ctrl, np.clip(np.asarray(path["action"]), -1, 1))
    np.testing.assert_allclose(recording.channels["q"].values[0], state.state.q)


def test_controls_of_increments_go_on_in_the_middle_of_an_episode():
    task = rb.envs.tasks()["cart_pole_balance"]()
    env = rb.envs.Environment(dataclasses.replace(task, action=rb.envs.Increment(0.1)))
    path, _ = log(env, 8, 0)
    _, state = env.reset(jax.random.key(0))
    applied = []
    for action in path["action"]:
        applied.append((state, state.ctrl))
        _, state, *_ = env.step_once(jax.random.key(2), state, action)
    applied.append((state, state.ctrl))
    middle = applied[3][0]
    recording = rb.envs.log_recording(env, path["obs"][3:], path["action"][3:], start=middle)
    due = [ctrl for _, ctrl in applied[4:]]
    np.testing.assert_allclose(recording.channels["ctrl"].values, due, atol=1e-12)
    np.testing.assert_allclose(recording.channels["q"].values[0], middle.state.q)
    with pytest.raises(rb.InputError, match=r"Increment depend .* give start=state"):
        rb.envs.log_recording(env, path["obs"], path["action"], start=middle.state)


def test_delays_are_refused():
    task = rb.envs.tasks()["cart_pole_balance"]()
    late = rb.envs.Environment(dataclasses.replace(task, action_delay=(2, 2)))
    with pytest.raises(rb.InputError, match=r"the action has a delay of \(2, 2\)"):
        rb.envs.log_recording(late, np.zeros((4, 5)), np.zeros((4, 1)))
    first, *others = task.observations["policy"]
    terms = [dataclasses.replace(first, delay=(0, 1)), *others]
    late = rb.envs.Environment(dataclasses.replace(task, observations={"policy": terms}))
    with pytest.raises(rb.InputError, match="the observation 'cart_position' has a delay"):
        rb.envs.log_recording(late, np.zeros((4, 5)), np.zeros((4, 1)))
    rest = [t.name for t in others]
    found = rb.envs.log_recording(late, np.zeros((4, 5)), np.zeros((4, 1)), rest)
    assert sorted(found.channels) == ["ctrl", *sorted(f"other:{x}" for x in rest)]


def identify(env, logged, start):
    """Find the mass of the pole from a log, with the model of the task as a first guess."""
    recording = rb.envs.log_recording(env, logged["obs"], logged["action"], start=start)
    setup = rb.sysid.Setup.of(env.task.model).with_sensors(rb.envs.observation_sensors(env))
    pole = env.task.model.body("pole")
    return rb.sysid.identify(
        setup, recording, {"mass": rb.sysid.Unknown("bodies.mass", pole, positive=True)},
        grid=rb.envs.control_grid(env), estimate_initial_state=False,
    )  # fmt: skip


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_mass_is_found_from_the_observations(noise):
    env = noisy_cart_pole(noise)
    bodies = env.task.model.bodies
    pole = env.task.model.body("pole")
    heavy = bodies.replace(mass=bodies.mass.at[pole].multiply(1.6))
    params = env.default_params.replace(model=env.task.model.replace(bodies=heavy))
    path, state = log(env, 150, 0, params)
    found = identify(env, path, state.state)
    interval = found.estimates.interval("mass")
    due = 1.6 * float(bodies.mass[pole])
    if noise:
        assert interval.low < due < interval.high
        assert interval.high - interval.low < 0.3 * due
    else:
        np.testing.assert_allclose(interval.value, due, rtol=1e-6)


def test_bad_input():
    env = rb.envs.make("damp_flexible_arm", randomise=False)
    with pytest.raises(rb.InputError, match=r"reads .*variable 'goal'"):
        rb.envs.observation_sensors(env, ["goal_error"])
    with pytest.raises(rb.InputError, match=r"reads .*the action"):
        rb.envs.observation_sensors(env, ["last_action"])
    with pytest.raises(rb.UnknownName, match="rate"):
        rb.envs.observation_sensors(env, ["rates"])
    with pytest.raises(rb.InputError, match="observations has shape"):
        rb.envs.log_recording(env, np.zeros((4, 3)), np.zeros((4, 1)))
    with pytest.raises(rb.InputError, match="env is"):
        rb.envs.observation_sensors(env.task)


def test_a_term_may_be_a_sensor():
    task = rb.envs.tasks()["cart_pole_balance"]()
    own = {"policy": (Observation("joints", "q"),)}
    env = rb.envs.Environment(dataclasses.replace(task, observations=own))
    sensor = rb.envs.observation_sensors(env)["other:joints"]
    state = rb.State(jnp.array([0.3, 0.1]), jnp.zeros(2))
    context = rb.forces.Context.of(task.model, 0.0, state, None)
    np.testing.assert_allclose(sensor(context), [0.3, 0.1])
