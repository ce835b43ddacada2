"""Limit cycles of hybrid systems, against digits that were computed with variational equations."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.solvers import integrate_until

TOLERANCE = 1e-12

#: slope, stance angle and rate after heel strike, period, eigenvalue, of the long gait
WALKERS = [
    (0.009, 0.20031090054425, -0.19983247300495, 3.8824637528514,
     -0.190099841066 + 0.557598776682j),
    (0.004, 0.15338956487623, -0.15608014667568, 3.852613461751,
     0.228889962888 + 0.591155194683j),
]  # fmt: skip


def walk(t, y, slope):
    """The simplest walker of Garcia, Chatterjee, Ruina & Coleman 1998: stance leg, swing leg."""
    leg, swing, rate, _ = y
    a = jnp.sin(leg - slope)
    b = a + rate**2 * jnp.sin(swing) - jnp.cos(leg - slope) * jnp.sin(swing)
    return jnp.stack([y[2], y[3], a, b])


def heel(t, y, slope):
    """Positive until heel strike; the legs pass each other at a leg angle near zero."""
    return jnp.where(y[0] > -0.1, 1.0, 2 * y[0] - y[1])


def step(y, slope):
    """The stance angle and rate after the next heel strike, and its time."""
    leg, rate = y
    c = jnp.cos(2 * leg)
    start = jnp.stack([leg, 2 * leg, rate, (1 - c) * rate])
    end = integrate_until(walk, start, heel, 6.0, slope, tolerance=TOLERANCE)
    leg, rate = -end.y[0], jnp.cos(2 * end.y[0]) * end.y[2]
    return jnp.stack([leg, rate]), end


@pytest.mark.parametrize(("slope", "leg", "rate", "period", "eigenvalue"), WALKERS)
def test_the_simplest_walker(slope, leg, rate, period, eigenvalue):
    slope = jnp.asarray(slope)
    found = rb.stability.limit_cycle(lambda y: step(y, slope)[0], [leg + 2e-3, rate - 2e-3])
    assert found.success and found.stable and found.residual < 1e-12
    np.testing.assert_allclose(found.state, [leg, rate], atol=1e-11)
    np.testing.assert_allclose(step(found.state, slope)[1].t, period, atol=1e-10)
    pair = sorted(found.eigenvalues, key=lambda x: -x.imag)
    np.testing.assert_allclose(pair, [eigenvalue, eigenvalue.conjugate()], atol=1e-9)


MASS, STIFFNESS, LENGTH, G = 80.0, 20e3, 1.0, 9.81
ENERGY = MASS * (5.0**2 / 2 + G * 1.0)
ATTACK = np.deg2rad(68)


def flight(t, y, args):
    return jnp.stack([y[2], y[3], 0.0 * t, -G + 0.0 * t])


def stance(t, y, args):
    l = jnp.sqrt(y[0] ** 2 + y[1] ** 2)
    f = STIFFNESS * (LENGTH - l) / (MASS * l)
    return jnp.stack([y[2], y[3], f * y[0], f * y[1] - G])


def apex_to_apex(y):
    """The height of the next apex of the spring-loaded inverted pendulum."""
    h = y[0]
    speed = jnp.sqrt(2 * (ENERGY / MASS - G * h))
    low = LENGTH * np.sin(ATTACK)
    start = jnp.stack([0.0 * h, h, speed, 0.0 * h])
    down = integrate_until(flight, start, lambda t, y, _: y[1] - low, 3.0, tolerance=TOLERANCE).y
    foot = down.at[0].set(-LENGTH * np.cos(ATTACK))
    up = integrate_until(
        stance, foot, lambda t, y, _: LENGTH**2 - y[0] ** 2 - y[1] ** 2, 3.0, leaving=True,
        tolerance=TOLERANCE,
    ).y  # fmt: skip
    top = integrate_until(flight, up, lambda t, y, _: y[3], 3.0, tolerance=TOLERANCE).y
    return top[1:2]


@pytest.mark.parametrize(
    ("guess", "apex", "eigenvalue"),
    [(0.95, 0.94026714438, -0.161307631), (1.33, 1.33768638137, 1.686967621)],
)
def test_the_spring_loaded_inverted_pendulum(guess, apex, eigenvalue):
    found = rb.stability.limit_cycle(apex_to_apex, [guess])
    np.testing.assert_allclose(found.state, [apex], atol=1e-10)
    np.testing.assert_allclose(found.eigenvalues, [eigenvalue], atol=1e-8)
    assert found.stable == (abs(eigenvalue) < 1)


def test_a_fixed_point_and_its_eigenvalues():
    """The linear map y -> A y + b has the fixed point (1 - A)^-1 b and the eigenvalues of A."""
    A, b = np.array([[0.2, -0.6], [0.4, 0.1]]), np.array([1.0, -2.0])
    found = rb.stability.limit_cycle(lambda y: jnp.asarray(A) @ y + b, np.zeros(2))
    np.testing.assert_allclose(found.state, np.linalg.solve(np.eye(2) - A, b), rtol=1e-12)
    np.testing.assert_allclose(found.jacobian, A, rtol=1e-12)
    expected = np.linalg.eigvals(A)
    np.testing.assert_allclose(np.sort(found.eigenvalues), np.sort(expected), rtol=1e-12)


def test_a_map_without_a_fixed_point():
    def shift(y):
        return y + 1 + 0.1 * y**2

    found = rb.stability.limit_cycle(shift, [0.3], throw=False, max_steps=8)
    assert not found.success and not found.stable and np.isnan(found.eigenvalues).all()
    with pytest.raises(rb.InputError, match="no fixed point near the guess"):
        rb.stability.limit_cycle(shift, [0.3], max_steps=8)


def test_bad_arguments():
    for wrong, message in [
        ({"return_map": 3, "guess": [1.0]}, "return_map"),
        ({"return_map": lambda y: y[:1], "guess": [1.0, 2.0]}, "expected shape"),
        ({"return_map": lambda y: y, "guess": 1.0}, "guess has shape"),
        ({"return_map": lambda y: y, "guess": [1.0], "max_steps": 0}, "max_steps is 0"),
        ({"return_map": lambda y: y, "guess": [1.0], "tolerance": 0}, "tolerance is 0"),
    ]:
        with pytest.raises(rb.InputError, match=message):
            rb.stability.limit_cycle(**wrong)
