"""`design` against optima in closed form, under limits of every kind."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid.design import Fourier, MotionLimits, Spline, design_experiment
from tests.sysid.two_link import regressor

quiet = functools.partial(design_experiment, progress=False)
ONE = Fourier(jnp.array([0.3]), jnp.array([[0.2]]), jnp.array([[0.1]]), period=4.0)


def spring_and_mass(q, v, a):
    return jnp.concatenate([q, a], 1)


def test_the_best_swing_of_a_spring_and_a_mass():
    """F = N [[q0^2 + A^2/2, -w^2 A^2/2], [., w^4 A^2/2]], so det F = N^2 w^4 A^2 q0^2 / 2, which
    |q0| + A <= 1 makes largest at q0 = A = 1/2. What is left is the margin, 1e-3 of the range."""
    found = quiet(ONE, spring_and_mass, MotionLimits(low=-1.0, high=1.0), samples=40)
    w = np.pi / 2
    best = -np.log(40**2 * w**4 / 32) / 2
    assert found.success and found.value < found.start_value
    # between two of 400 times the peak may be higher by (pi/400)^2/2 = 3e-5
    assert best - 1e-4 < found.value < best + 5e-3
    assert abs(abs(found.motion.q0[0]) - 0.5) < 0.01
    assert found.worst["position"] <= 0
    assert "all limits hold at 400 times" in found.summary()
    np.testing.assert_allclose(-np.log(np.linalg.det(found.information)) / 2, found.value)


def test_the_next_best_experiment():
    """After an experiment that has shown the spring well, only the mass is left: what counts is
    w^4 A^2/2, so q0 goes to 0 and A to 1. One more of the first kind would say less."""
    known = 1e6 * np.diag([1.0, 0.0])
    limits = MotionLimits(low=-1.0, high=1.0)
    found = quiet(ONE, spring_and_mass, limits, known=known, criterion="A", samples=40)
    swing = np.max(np.abs(found.motion(jnp.linspace(0, 4, 400)).q))
    assert found.success and abs(found.motion.q0[0]) < 0.02 and abs(swing - 1) < 0.01
    exact = np.log(1e-6 + 1 / (40 * (np.pi / 2) ** 4 / 2))
    assert abs(found.value - exact) < 0.02
    q, v, a = (jnp.full((40, 1), 0.0),) * 3
    assert np.linalg.matrix_rank(found.information - known) == 2
    assert np.linalg.matrix_rank(known + spring_and_mass(q, v, a).T @ spring_and_mass(q, v, a)) == 1


@pytest.fixture(scope="module")
def arm():
    return rb.load("double_pendulum")


def start(key=0):
    return Fourier.random(jax.random.key(key), jnp.zeros(2), 3, period=6.0, speed=0.3)


def test_limits_of_every_kind_hold(arm):
    """Checked apart from `design`, at other times, with `rb.inverse_dynamics` one by one."""

    def own(q, v, a):
        return jnp.sin(q[0]) + jnp.sin(q[0] + q[1]) - 0.8  # the hand stays beside a wall

    limits = MotionLimits(
        low=[-1.5, -2.0], high=[1.2, 2.0], speed=[2.0, 2.5], acceleration=6.0, torque=[16.0, 5.0],
        model=arm, own=own,
    )  # fmt: skip
    found = quiet(start(), regressor, limits, samples=50, rounds=8, steps=40)
    assert found.success
    assert set(found.worst) == {"position", "speed", "acceleration", "torque", "own"}
    assert found.value < found.start_value - 0.5
    q, v, a = found.motion(jnp.linspace(0, 6, 333))
    assert (q >= np.array([-1.5, -2.0]) - 1e-6).all() and (q <= np.array([1.2, 2.0]) + 1e-6).all()
    assert (abs(v) <= np.array([2.0, 2.5]) + 1e-6).all() and (abs(a) <= 6 + 1e-6).all()
    tau = np.array([rb.inverse_dynamics(arm, *x) for x in zip(q[::9], v[::9], a[::9], strict=True)])
    assert (np.abs(tau) <= np.array([16.0, 5.0]) + 1e-6).all()
    assert max(own(*x) for x in zip(q, v, a, strict=True)) <= 1e-6
    assert max(found.worst.values()) > -0.02  # the best motion is at a limit


def test_the_unknowns_of_a_fit_on_its_own_model(arm):
    """The Jacobian of the model's inverse dynamics by a mass, an inertia's place and an armature,
    by JAX: the bounds on their errors become smaller by as much as the criterion says."""

    def torque(p, q, v, a):
        bodies, joints = arm.bodies, arm.joints
        changed = arm.replace(
            bodies=bodies.replace(
                mass=bodies.mass.at[1].multiply(p[0]), com=bodies.com.at[1, 2].multiply(p[1])
            ),
            joints=joints.replace(armature=joints.armature.at[0].add(0.1 * p[2])),
        )
        return rb.inverse_dynamics(changed, q, v, a)

    def information(q, v, a):
        by_p = jax.vmap(jax.jacfwd(torque), (None, 0, 0, 0))
        return by_p(jnp.array([1.0, 1.0, 0.0]), q, v, a).reshape(-1, 3) / 0.1

    limits = MotionLimits(low=-2.0, high=2.0, speed=3.0)
    found = quiet(start(), information, limits, criterion="A", samples=30, rounds=4, steps=30)
    J = np.asarray(information(*found.motion(jnp.arange(30) * 0.2)))
    variance = np.trace(np.linalg.inv(J.T @ J))
    assert found.success and abs(np.exp(found.value) / variance - 1) < 1e-9
    assert variance < 0.2 * np.exp(found.start_value)


@pytest.mark.parametrize("criterion", ["E", "condition"])
def test_other_criteria(criterion):
    limits = MotionLimits(low=-1.5, high=1.5, speed=2.0)
    found = quiet(start(), regressor, limits, criterion=criterion, samples=40, rounds=4, steps=30)
    assert found.success and found.value < found.start_value - 0.3


def test_splines_from_rest_to_rest():
    first = Spline.random(jax.random.key(2), jnp.zeros(2), 6, duration=4.0, size=0.3)
    limits = MotionLimits(low=-1.5, high=1.5, speed=2.0)
    found = quiet(first, regressor, limits, samples=40, rounds=5, steps=40)
    assert found.success and found.value < found.start_value - 0.5
    _, v, a = found.motion(jnp.array([0.0, 4.0]))
    np.testing.assert_allclose(np.stack([v, a]), 0, atol=1e-12)


def test_a_start_within_the_limits_gives_a_result_within_them():
    """However few the rounds are; and the result is never worse than the start."""
    small = Fourier(ONE.q0, 0.1 * ONE.a, 0.1 * ONE.b, period=4.0)
    limits = MotionLimits(low=-1.0, high=1.0, speed=1.0)
    found = quiet(small, spring_and_mass, limits, samples=20, rounds=1, steps=8)
    assert found.success and found.value < found.start_value - 0.1
    same = quiet(small, spring_and_mass, MotionLimits(speed=1e-1), samples=20, rounds=1, steps=1)
    assert same.success and same.value <= same.start_value


def test_limits_that_cannot_hold_are_said():
    limits = MotionLimits(own=lambda q, v, a: 0.1 + q**2)
    found = quiet(ONE, spring_and_mass, limits, samples=20, rounds=3, steps=20)
    assert not found.success and found.worst["own"] >= 0.1
    assert "limits are broken: own by" in found.summary()
