"""Relaxation: its steady limit, its step response, and what it never does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.wheeled import Coulomb, Fiala, LinearTyre, Relaxing
from tests.wheeled.laws import EVERY, LAWS, limits, numbers, replaced, slopes_agree

MOTION = 8.0, 0.4, 8.3


def steady(tyre, ux, uy, roll):
    """The deflection whose rate is zero, from the equation in Rill's form."""
    v = jnp.hypot(roll, tyre.law.smooth_speed)
    G = tyre.law.secants((ux - roll) / v, uy / v)
    slides = jnp.array([ux - roll, uy])
    return -jnp.stack(G) * slides / (jnp.stack(tyre.carcass) * v)


@EVERY
def test_steady_traction_is_the_laws(law):
    tyre = Relaxing(law, [0.2, 0.4], 0.01)
    mu, rates = tyre.response(*MOTION, steady(tyre, *MOTION))
    np.testing.assert_allclose(rates, 0, atol=1e-13)
    np.testing.assert_allclose(mu, law.response(*MOTION)[0], rtol=1e-13)
    assert tyre.size == 2


def test_step_response():
    """A linear law that starts to slip: exponential, of the length sigma + v tau."""
    tyre = Relaxing(LinearTyre([12.0, 9.0], smooth_speed=1e-5), [0.2, 0.4], 0.03)
    v, slides = 3.0, np.array([-0.2, 0.3])
    sigma = np.array([0.2, 0.4])

    def rate(z):
        return jnp.stack(tyre.response(v + slides[0], slides[1], v, z)[1])

    @jax.jit
    def after(steps, h):
        def step(_, z):
            a = rate(z)
            b = rate(z + h / 2 * a)
            c = rate(z + h / 2 * b)
            return z + h / 6 * (a + 2 * b + 2 * c + rate(z + h * c))

        return jax.lax.fori_loop(0, steps, step, jnp.zeros(2))

    for steps in (20, 100, 400):
        t = steps * 1e-3
        want = -sigma * slides / v * (1 - np.exp(-v * t / (sigma + 0.03 * v)))
        np.testing.assert_allclose(after(steps, 1e-3), want, rtol=1e-9)


@EVERY
def test_power(law):
    """mu . v_s = -d/dt (c zeta^2 / 2) - c tau zeta'^2 - mu^2 v / G."""
    tau, rng = 0.02, np.random.default_rng(5)
    tyre = Relaxing(law, [0.2, 0.4], tau)
    ux, uy, roll = rng.normal(size=(3, 200)) * 10 ** rng.uniform(-4, 1, 200)
    z = jnp.asarray(rng.normal(size=(2, 200)) * 0.05)
    (x, y), rates = tyre.response(jnp.asarray(ux), jnp.asarray(uy), jnp.asarray(roll), z)
    v = np.hypot(roll, law.smooth_speed)
    G = law.secants((ux - roll) / v, uy / v)
    _, storing = jax.jvp(tyre.stored, (z,), (jnp.stack(rates),))
    lost = sum(
        c * tau * dz**2 + mu**2 * v / g
        for c, dz, mu, g in zip(tyre.carcass, rates, (x, y), G, strict=True)
    )
    power = x * (ux - roll) + y * uy
    scale = np.abs(power) + np.abs(storing) + lost
    assert np.max(np.abs(power + storing + lost) / scale) < 1e-12


def followed(tyre, motions, h):
    """mu and zeta along motions (n, 3) that are held for h each, exactly."""

    def hold(z, motion):
        ends = steady(tyre, *motion)
        rates = jnp.stack(tyre.response(*motion, ends + 1.0)[1])  # per metre away from there
        z = ends + (z - ends) * jnp.exp(rates * h)
        return z, jnp.stack([*tyre.response(*motion, z)[0], *z])

    run = jax.jit(lambda motions: jax.lax.scan(hold, jnp.zeros(2), motions)[1])
    return np.asarray(run(jnp.asarray(motions)))


@pytest.mark.parametrize("tau", [0.0, 0.01])
def test_traction_stays_within_bounds(tau):
    """Of an ellipse where one length and one curve serve both axes, else of each axis."""
    rng = np.random.default_rng(6)
    motions = rng.normal(size=(300, 3)) * 10 ** rng.uniform(-3, 1.5, (300, 1))
    for name in ("fiala, two", "pacejka, two heights", "coulomb", "tmeasy"):
        law = replaced(LAWS[name], smooth_speed=1e-3)
        mu = followed(Relaxing(law, 0.2, tau), motions, 0.02)[:, :2] / limits(law)
        assert np.max((mu**2).sum(1)) < 1 + 1e-9
    law = LAWS["tmeasy, two"]
    mu = followed(Relaxing(law, [0.2, 0.5], tau), motions, 0.02)[:, :2] / limits(law)
    assert np.abs(mu).max() < 1 + 1e-9


def test_a_locked_wheel_does_not_wind_up():
    """It slides for 20 m; when it stops, no more is stored than friction allows."""
    tyre = Relaxing(Fiala(12.0, 0.8, smooth_speed=1e-4), 0.3)
    slid = followed(tyre, [[10.0, 0.0, 0.0]] * 100, 0.02)
    np.testing.assert_allclose(slid[-1], [-0.8, 0.0, -0.8 / (12 / 0.3), 0.0], atol=1e-9)
    back = followed(tyre, [[10.0, 0.0, 0.0]] * 100 + [[-1.0, 0.0, 0.0]] * 5, 0.02)
    assert back[-1, 0] > 0.7  # after 10 cm


def test_a_parked_wheel_holds_on_a_slope():
    """A mass on a locked wheel: it settles on the spring of the carcass. From then on it creeps at
    v_n times the slip that the law needs for its load: here by 0.2 micrometres a second."""
    law = Fiala(12.0, 0.8, smooth_speed=1e-5)
    tyre, pull = Relaxing(law, 0.3, 0.02), 9.81 * 0.2

    @jax.jit
    def after(steps, h):
        def step(_, y):
            x, v, zx = y
            (mu, _), (rate, _) = tyre.response(v, 0.0, 0.0, (zx, 0.0))
            v = v + h * (pull + 9.81 * mu)
            return x + h * v, v, zx + h * rate

        return jax.lax.fori_loop(0, steps, step, (0.0, 0.0, 0.0))

    x, v, z = after(20_000, 5e-4)
    np.testing.assert_allclose(-z, 0.2 / (12.0 / 0.3), rtol=1e-3)
    slip = 3 * 0.8 / 12 * (1 - np.cbrt(1 - 0.2 / 0.8))  # where Fiala's law gives 0.2
    np.testing.assert_allclose(law.traction(-slip, 0.0)[0], 0.2, rtol=1e-14)
    np.testing.assert_allclose(v, 1e-5 * slip, rtol=1e-3)
    assert 0 < x + z < 0.01  # what slid while it settled


@EVERY
def test_derivatives_by_every_number(law):
    tyre = Relaxing(law, [0.2, 0.4], 0.01)
    row, back = numbers(tyre)
    motions = [(*MOTION, 0.01, -0.02), (0.0, 0.0, 0.0, 0.01, 0.0), (6.0, 0.0, 0.0, -0.1, 0.2)]

    def f(x):
        tyre, rest = back(x[: row.size]), x[row.size :].reshape(-1, 5)
        every = [tyre.response(*m[:3], (m[3], m[4])) for m in rest]
        return jnp.stack([x for response in every for pair in response for x in pair])

    assert slopes_agree(f, jnp.concatenate([row, jnp.ravel(jnp.array(motions))])) < 1e-10


def test_bad_numbers():
    with pytest.raises(rb.InputError, match=r"Relaxing: law is 10.0, expected a tyre law"):
        Relaxing(10.0, 0.3)
    with pytest.raises(rb.InputError, match=r"length=.* above 0"):
        Relaxing(Coulomb(0.8), 0.0)
    with pytest.raises(rb.InputError, match=r"damping_time=.* got -0.1, expected .* of at least 0"):
        Relaxing(Coulomb(0.8), 0.3, -0.1)
