"""Pushes: when they act, and the velocity that they give."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.envs import terms
from rbjax.model.record import Record

VALUES = {
    "push_time": jnp.array([0.1, 0.1]), "push_wait": jnp.array([0.2, 0.4]),
    "push_duration": jnp.array([0.1, 0.2]), "push_speed": jnp.array([1.0, 2.0]),
}  # fmt: skip
PARAMS = SimpleNamespace(values=VALUES)


class Episode(Record):
    state: rb.State
    step: jax.Array
    variables: dict


def run(made, steps, params=PARAMS):
    """Velocities after each step of a robot on which only pushes act, and the variables."""
    variables, event = made
    start = {
        v.name: jnp.asarray(v.start(jax.random.key(k), params)) for k, v in enumerate(variables)
    }
    state = Episode(rb.State(jnp.zeros(7), jnp.zeros(6)), jnp.int32(0), start)

    def one(state, key):
        state = event.apply(key, state, params)
        state = state.replace(step=state.step + 1)
        return state, (state.state.v, state.variables)

    return jax.lax.scan(one, state, jax.random.split(jax.random.key(9), steps))[1]


def test_velocity_pushes():
    v, _ = run(terms.velocity_pushes(0.02), 22)
    change = np.diff(np.concatenate([np.zeros((1, 6)), v]), axis=0)
    speeds = np.linalg.norm(change[:, :2], axis=1)
    assert np.flatnonzero(speeds).tolist() == [4, 9, 14, 19]  # every 0.1 s
    assert ((speeds[speeds > 0] >= 1) & (speeds[speeds > 0] <= 2)).all()
    assert (change[:, 2:] == 0).all()


def test_force_pushes():
    v, path = run(terms.force_pushes(0.02), 200)
    change = np.diff(np.concatenate([np.zeros((1, 6)), v]), axis=0)
    a, acceleration = np.linalg.norm(change[:, :2], axis=1) / 0.02, path["push"]
    np.testing.assert_allclose(np.linalg.norm(acceleration, axis=1), a, atol=1e-13)
    wait, duration, speed = (
        float(path[f"push_{x}"][0]) for x in ("wait_steps", "duration", "speed")
    )
    wait, time = round(wait), np.arange(0, duration, 0.02)
    due = np.sin(np.pi * time / duration) * speed / (2 * duration)
    np.testing.assert_allclose(a[wait : wait + len(due)], due, atol=1e-12)
    assert (a[:wait] == 0).all() and (a[wait + len(due) : wait + len(due) + 5] == 0).all()
    # the sum over a push is about s / pi
    assert abs(due.sum() * 0.02 * np.pi / speed - 1) < 0.1
    starts = np.flatnonzero((a[1:] > 0) & (a[:-1] == 0))
    assert len(starts) >= 3 and np.ptp(np.diff(starts)) == 0
    angles = np.arctan2(*change[starts + 1, 1::-1].T)
    assert np.ptp(angles) > 0.1  # each push has its own direction


def test_times_of_zero():
    params = SimpleNamespace(values=VALUES | {"push_time": [0.0, 0.0], "push_duration": [0.0, 0.0]})
    v, _ = run(terms.velocity_pushes(0.02), 4, params)
    assert (np.diff(np.linalg.norm(v, axis=1)) != 0).all()  # a push in each control step
    v, path = run(terms.force_pushes(0.02), 60, params)
    assert (v == 0).all() and (path["push"] == 0).all()  # no push
