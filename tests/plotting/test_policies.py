"""Policies in motion: recorded episodes against `env.step`, and their animations."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.plotting import animate_policy, animation, record_policy
from rbjax.plotting.policies import _random_actions
from rbjax.viewer import motion_of_policy

BALL = """<mujoco><option timestep="0.002"/><worldbody>
  <geom name="floor" type="plane" size="0 0 1"/>
  <body pos="0 0 0.1"><freejoint/><geom size="0.1" density="1000"/></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def env() -> rb.envs.Environment:
    return rb.envs.make("cart_pole_balance")


def test_a_recording_is_the_motion_of_the_environment(env) -> None:
    """Without resets: the same states as steps of a loop with the same keys."""

    def policy(obs, key):
        return 0.3 * jnp.tanh(obs[:1])

    found = record_policy(env, policy, seconds=4 * env.dt, samples=2, seed=3)
    first, key = jax.random.split(jax.random.key(3))
    obs, state = jax.vmap(env.reset)(jax.random.split(first, 2))
    np.testing.assert_array_equal(found.trajectory.q[:, 0], state.state.q)
    for i, step in enumerate(jax.random.split(key, 4)):
        _, stepped = (jax.random.split(k, 2) for k in jax.random.split(step))
        action = 0.3 * jnp.tanh(obs[:, :1])
        obs, state, reward, _, _ = jax.vmap(env.step)(stepped, state, action)
        np.testing.assert_allclose(found.trajectory.q[:, i + 1], state.state.q, atol=1e-9)
        np.testing.assert_allclose(found.reward[:, i], reward, atol=1e-9)
    assert found.done.shape == (2, 4) and found.trajectory.success.all()
    np.testing.assert_allclose(found.trajectory.ts, env.dt * np.arange(5))


def test_random_actions_differ_between_samples(env) -> None:
    q = record_policy(env, samples=3, seconds=0.2).trajectory.q
    assert len(np.unique(np.asarray(q[:, -1]), axis=0)) == 3


def test_random_actions_are_in_the_range_of_an_action() -> None:
    """With one limit or none they are in -1..1, as the actions of a policy are."""
    limits = np.array([2.0, 0.0, -np.inf]), np.array([3.0, np.inf, np.inf])
    env: Any = SimpleNamespace(action_range=limits, action_size=3, dtype=jnp.zeros(()).dtype)
    keys = jax.random.split(jax.random.key(0), 200)
    found = np.asarray(jax.vmap(_random_actions(env), (None, 0))(None, keys))
    np.testing.assert_allclose(found.min(0), [2, -1, -1], atol=0.05)
    np.testing.assert_allclose(found.max(0), [3, 1, 1], atol=0.05)


def test_a_page_in_one_call(env, tmp_path: Path) -> None:
    file = animate_policy(env, None, tmp_path / "a.html", seconds=0.2, samples=60, fps=10)
    text = file.read_text()
    assert "cart pole balance" in text and '"samples": 60' in text


def test_the_view_follows_the_tracked_body(env, tmp_path: Path, monkeypatch) -> None:
    films = []
    monkeypatch.setattr(animation, "write_page", lambda path, film, *args, **k: films.append(film))
    for name, index in (("pole", 1), (None, 0)):
        own = rb.envs.Environment(dataclasses.replace(env.task, tracked=name))
        animate_policy(own, None, tmp_path / "a.html", seconds=0.2, fps=50, follow=True)
        (shown,) = films
        np.testing.assert_allclose(shown.middle, shown.p[0, :, index], atol=1e-12)
        np.testing.assert_allclose(shown.centre, shown.middle, atol=1e-12)
        motion_of_policy(own, None, seconds=0.1).animate(tmp_path / "b.html")
        shown = films[1]
        np.testing.assert_allclose(shown.middle, shown.p[0, :, index], atol=1e-12)
        films.clear()
    with pytest.raises(rb.UnknownName, match="body 'poles'"):
        rb.envs.Environment(dataclasses.replace(env.task, tracked="poles"))


def test_errors(env, tmp_path: Path) -> None:
    with pytest.raises(rb.InputError, match=r"expected one that ends in \.gif"):
        animate_policy(env, None, tmp_path / "a.txt")
    with pytest.raises(rb.InputError, match="env is 'cart_pole_balance'"):
        record_policy("cart_pole_balance")
    with pytest.raises(rb.InputError, match="policy is int, expected a function"):
        record_policy(env, 3)
    with pytest.raises(rb.InputError, match="samples"):
        record_policy(env, samples=0)


def test_contact_forces_of_the_law_of_the_task() -> None:
    """A ball at rest on the floor: its weight, if only the task has a law of contact."""
    model = rb.load(BALL)
    task = rb.envs.Task(
        "ball", model.replace(contact=None), start=lambda key, params: model.default_state(),
        observations={"policy": (rb.envs.Observation("v", lambda to: to.after.v),)},
        rewards=(rb.envs.Reward("none", lambda to: 0.0),),
        contact=rb.contact.SoftContact(iterations=20), dt=0.002, decimation=5,
    )  # fmt: skip
    found = record_policy(rb.envs.Environment(task), seconds=1.0)
    assert found.contacts is not None
    up = np.asarray(found.contacts.world_force)[-1, :, 2]
    assert abs(up.sum()) == pytest.approx(9.81 * float(model.bodies.mass.sum()), rel=1e-3)


@pytest.mark.slow
def test_contact_forces_of_the_first_robot() -> None:
    """A hopper that falls on the ground: once it lies, forces carry its weight on average."""
    env = rb.envs.make("hopper_stand")
    found = record_policy(env, lambda obs, key: jnp.zeros(env.action_size, env.dtype), seconds=3.0)
    assert found.contacts is not None
    up = np.asarray(found.contacts.world_force)[..., 2]
    weight = 9.81 * float(env.task.model.bodies.mass.sum())
    total = np.abs(up.sum(-1))[-50:].mean()
    assert total == pytest.approx(weight, rel=0.1)
