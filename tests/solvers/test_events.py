"""Integration until an event, against closed forms, with first and second derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.solvers import carry_back, integrate_until

G = 9.81


def fall(t, y, g):
    return jnp.stack([y[1], -g])


def height(t, y, g):
    return y[0]


def touch(h, w=0.0, g=G, **options):
    y0 = jnp.stack(jnp.broadcast_arrays(jnp.asarray(h, float), -jnp.asarray(w, float)))
    return integrate_until(fall, y0, height, 5.0, jnp.asarray(g, float), **options)


def test_the_time_of_an_event_and_its_derivatives():
    """T = sqrt(2 h / g) of a ball that falls from rest."""

    def time(h):
        return touch(h).t

    value, slope = jax.value_and_grad(time)(1.3)
    np.testing.assert_allclose(value, np.sqrt(2 * 1.3 / G), rtol=1e-14)
    np.testing.assert_allclose(slope, 0.5 * np.sqrt(2 / (1.3 * G)), rtol=1e-13)
    np.testing.assert_allclose(jax.jvp(time, (1.3,), (1.0,))[1], slope, rtol=1e-13)


def test_the_second_derivative_of_an_event():
    second = jax.hessian(lambda h: touch(h).t)(1.3)
    np.testing.assert_allclose(second, -0.25 * np.sqrt(2 / (1.3**3 * G)), rtol=1e-11)


def test_no_event_and_saved_times():
    ts = jnp.array([0.0, 0.1, 0.2, 0.7])
    found = touch(200.0, ts=ts)
    assert found.success and not found.reached and found.t == 5.0
    np.testing.assert_allclose(found.ys[:, 0], 200 - G / 2 * ts**2, rtol=1e-13)
    found = touch(0.1, ts=ts)  # held after the event
    assert found.reached
    np.testing.assert_allclose(found.ys[2:, 0], 0.0, atol=1e-11)
    np.testing.assert_allclose(found.ys[1, 0], 0.1 - G / 2 * 0.01, rtol=1e-12)


def test_an_event_at_the_start_and_one_that_is_left():
    assert touch(0.0, 1.0).t == 0.0 and touch(0.0, 1.0).reached
    thrown = touch(0.0, -2.0, leaving=True)
    np.testing.assert_allclose(thrown.t, 2 * 2.0 / G, rtol=1e-14)
    tiny = touch(0.0, -1e-9, leaving=True)  # a bounce of 0.2 ns
    np.testing.assert_allclose(tiny.t, 2e-9 / G, rtol=1e-6)


def test_a_failure_is_reported():
    stiff = integrate_until(
        lambda t, y, args: 1e6 * jnp.cos(1e6 * t) * jnp.ones(1), jnp.zeros(1),
        lambda t, y, args: 2.0 - y[0], 10.0, max_steps=5,
    )  # fmt: skip
    assert not stiff.success and not stiff.reached
    blown = integrate_until(
        lambda t, y, args: y**2, jnp.ones(1), lambda t, y, args: 1e30 - y[0], 2.0
    )
    assert not blown.success


def test_the_saltation_matrix():
    """S = [[-e, 0], [(1 + e) g / |v|, -e]] of a bounce at z = 0."""
    e, v = 0.6, 3.0

    def over(dy):
        before = touch(dy[0], v - dy[1])
        after = jnp.stack([before.y[0], -e * before.y[1]])
        return carry_back(fall, before.t, after, jnp.asarray(G), before.located)

    S = jax.jacfwd(over)(jnp.zeros(2))
    np.testing.assert_allclose(S, [[-e, 0], [(1 + e) * G / v, -e]], atol=1e-12)
    np.testing.assert_allclose(jax.jacrev(over)(jnp.zeros(2)), S, atol=1e-12)


def test_batches_and_single_precision():
    h = jnp.array([0.5, 1.0, 2.0])
    np.testing.assert_allclose(jax.vmap(lambda h: touch(h).t)(h), np.sqrt(2 * h / G), rtol=1e-13)
    y0, g = jnp.array([1.0, 0.0], jnp.float32), jnp.asarray(G, jnp.float32)
    found = integrate_until(fall, y0, height, 5.0, g)
    assert found.t.dtype == found.y.dtype == jnp.float32
    np.testing.assert_allclose(found.t, np.sqrt(2 / G), rtol=1e-5)


def test_bad_arguments():
    with pytest.raises(rb.InputError, match=r"the guard returned .* expected one number"):
        integrate_until(fall, jnp.zeros(2), lambda t, y, g: y, 1.0, G)
    with pytest.raises(rb.InputError, match="y0 has dtype int"):
        integrate_until(fall, jnp.zeros(2, int), height, 1.0, G)
    with pytest.raises(rb.InputError, match="tolerance is -1"):
        touch(1.0, tolerance=-1)
    with pytest.raises(rb.InputError, match="max_steps is 0"):
        touch(1.0, max_steps=0)
