"""Derivatives through impacts and friction against closed forms, at a step of 2 ms."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.impacts.time_of_impact import touchdown
from tests import oracles
from tests.contact import scenes
from tests.contact.closed_forms import PLANAR, ROLLING, Body, G, Touch, load

ORACLE = oracles.load("contact")
DT = 2e-3
FREE_SLIDE = '<joint type="slide" axis="1 0 0"/>'


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_two_balls(mode):
    given = ORACLE["two_balls"]
    ball = f'<body>{FREE_SLIDE}<geom type="sphere" size="{given["r"]}" mass="1"/></body>'
    model = scenes.load(2 * ball, gravity=0.0, floor="")
    law = rb.contact.MoreauContact.of(model, restitution=given["e"], friction=0.0, pairs=[(0, 1)])

    def end(x):
        state = rb.State(x[:2], x[2:])
        return rb.rollout(
            model, state, None, DT, steps=round(given["T"] / DT), dynamics=law
        ).q[-1, 1]  # fmt: skip

    at = jnp.array([given[k] for k in ("x1", "x2", "v0", "u0")])
    np.testing.assert_allclose(end(at), given["x_final_of_ball_2"], rtol=1e-12)
    slope = jax.jit(mode(end))(at)
    np.testing.assert_allclose(slope, given["gradient_wrt_x1_x2_v0_u0"], atol=1e-9)


def test_a_bounce_with_gravity_at_each_phase_of_the_step():
    """z = e w tau - g tau^2 / 2 and its derivatives by height, restitution and gravity."""
    model, T, e = scenes.load(scenes.ball(height=0.1)), 0.7, 0.6
    law = rb.contact.MoreauContact.of(model, restitution=e)

    def height(h, e, g):
        falling = model.replace(gravity=jnp.array([0, 0, -1.0]) * g)
        state, own = rb.State(h[None], jnp.zeros(1)), law.replace(restitution=e[None])
        path = rb.rollout(falling, state, None, DT, steps=round(T / DT), dynamics=own)
        return path.q[-1, 0]

    slopes = jax.jit(jax.value_and_grad(height, (0, 1, 2)))
    for h in (1.0, 1.001, 1.0033, 1.013):
        w = np.sqrt(2 * G * h)
        s = T - w / G
        z, found = slopes(jnp.asarray(h), jnp.asarray(e), jnp.asarray(G))
        np.testing.assert_allclose(z, e * w * s - G * s**2 / 2, rtol=1e-9)
        by_g = e * s * w / (2 * G) + e * w**2 / (2 * G**2) - s**2 / 2 - s * w / (2 * G)
        np.testing.assert_allclose(found, [(1 + e) * G * s / w - e, w * s, by_g], rtol=1e-7)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_sliding_pushing_and_rolling(mode):
    """Distances of a block that stops, of a brick that is pushed, and of a ball that rolls."""
    T, until, v, mu, F = 2.4, 1.0, 6.0, 0.5, 10.0
    model = load([Body(Touch(mu), PLANAR), Body(Touch(mu), PLANAR), Body(Touch(mu), ROLLING)])
    law = rb.contact.MoreauContact.of(model)

    def end(x):
        start = model.default_state().replace(v=jnp.zeros(7).at[jnp.array([0, 4])].set(x[0]))
        path = rb.rollout(
            model, start, None, DT, steps=round(T / DT), dynamics=law.replace(friction=x[1] * one),
            tau=lambda t, state: jnp.zeros(7).at[2].set(jnp.where(t < until - 1e-9, x[2], 0.0)),
        )  # fmt: skip
        return path.q[-1, jnp.array([0, 2, 4])]

    one, at = jnp.ones(3), jnp.array([v, mu, F])
    rest, a = v**2 / (2 * mu * G), mu * G
    pushed = (F - a) * F * until**2 / (2 * a)
    exact = np.array([rest, pushed, 5 * v * T / 7 + 2 * v**2 / (49 * a)])
    np.testing.assert_allclose(jax.jit(end)(at), exact, rtol=1e-6)
    slopes = [
        [v / a, -rest / mu, 0],
        [0, -(F**2) * until**2 / (2 * a * mu), until**2 * (2 * F - a) / (2 * a)],
        [5 * T / 7 + 4 * v / (49 * a), -2 * v**2 / (49 * a * mu), 0],
    ]
    np.testing.assert_allclose(jax.jit(mode(end))(at), slopes, rtol=1e-6, atol=1e-9)


def test_the_bias_of_a_soft_contact_at_touch():
    """MuJoCo's law has dz/dh = -e - c e (T - t_touch - t_c - c/k) for small steps, not -e."""
    k, c, h, T, dt = 1e4, 60.0, 0.05, 0.2, 1e-4
    solref = f"{-k} {-c}"
    touch = Touch(condim=1, solref=solref, solimp="0.9999 0.9999 0.001 0.5 2")
    slide = '<joint type="slide" axis="0 0 1"/>'
    model = load([Body(touch, slide, height=0.1 + h)], gravity="0 0 0")

    @jax.jit
    def slope(h):
        def end(x):
            state = model.default_state().replace(q=x[None], v=-jnp.ones(1))
            step = lambda i, s: rb.step(model, s, dt=dt, contact="mujoco")  # noqa: E731
            return jax.lax.fori_loop(0, round(T / dt), step, state).q[0]

        return jax.jvp(end, (h,), (jnp.ones(()),))[1]

    beta = c / 2
    w = np.sqrt(k - beta**2)
    t_c = (np.pi - np.arctan2(2 * beta * w, w**2 - beta**2)) / w
    e = np.exp(-beta * t_c)
    expected = -e - c * e * (T - h - t_c - c / k)
    with pytest.warns(UserWarning, match="step: a derivative .* biased at any step size"):
        found = slope(jnp.zeros(()))
    np.testing.assert_allclose(found, expected, rtol=0.02)
    assert abs(expected + e) > 5 * e


def test_events_of_a_step():
    """A rebound, a landing that stays, a contact at rest, one that only touches, one far away."""
    gap, u = np.array([1e-3, 1e-3, 0.0, 0.0, 1.0]), np.array([-1.0, -1.0, 0.0, 1e-9, -1.0])
    alpha, e = np.array([-G, -G, -G, 0.0, -G]), np.array([0.5, 0.0, 0.5, 0.5, 0.5])
    found = touchdown(gap, u, alpha, e, 1e-3, 0.1, DT)
    assert found.active.tolist() == [True, True, True, True, False]
    assert found.leaves.tolist() == [True, False, False, False, False]
    s = (np.sqrt(1 + 2 * G * 1e-3) - 1) / G
    w = 1 + G * s
    np.testing.assert_allclose(found.velocity[:3], [0.5 * w - G * (DT - s), 0, 0], atol=1e-12)
    np.testing.assert_allclose(found.mean[1:3], [-1e-3 / DT, 0], atol=1e-12)
    np.testing.assert_allclose(found.part[:2], [(DT - s) / DT, 0.5], rtol=1e-12)
    rate = jax.jacfwd(lambda x: jnp.stack(touchdown(x, u, alpha, e, 1e-3, 0.1, DT)[2:]))(gap)
    assert np.isfinite(rate).all()
