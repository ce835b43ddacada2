"""Poses by the angles of wheels: against the closed form, rollouts and finite differences."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import wheeled
from rbjax.errors import InputError
from rbjax.wheeled import HeadingSlip

ROBOT = wheeled.kinds()["omni_3"].make(arm=0.2, radius=0.05)
T = np.array([0.0, 0.3, 0.7, 1.5])


def test_a_constant_twist_is_an_arc_exactly():
    v, w = np.array([0.3, -0.2]), 1.1
    rates = np.asarray(wheeled.commands(ROBOT, [*v, w]).speeds)
    poses = wheeled.odometry(ROBOT, T, T[:, None] * rates, pose=[1.0, 2.0, 0.5])
    s, c = np.sin(w * T), np.cos(w * T)
    ahead = np.stack([s * v[0] - (1 - c) * v[1], (1 - c) * v[0] + s * v[1]], -1) / w
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    np.testing.assert_allclose(poses[:, :2], [1.0, 2.0] + ahead @ turn.T, atol=1e-12)
    np.testing.assert_allclose(poses[:, 2], 0.5 + w * T, atol=1e-12)


@pytest.mark.parametrize("kind", ["omni_3", "mecanum"])
def test_rolled_twists_are_the_inverse_of_commands(kind):
    robot = wheeled.kinds()[kind].make()
    twist = jnp.array([0.3, -0.2, 0.7])
    again = wheeled.rolled_twists(robot, wheeled.commands(robot, twist).speeds)
    np.testing.assert_allclose(again, twist, atol=1e-12)


def test_mean_twists_are_the_inverse_of_odometry():
    rng = np.random.default_rng(0)
    angles = np.cumsum(rng.normal(size=(4, 3)), 0)
    slip = HeadingSlip.none(0.2, 5, 1)
    slip = slip.replace(coefficients=slip.coefficients + 0.1 * rng.normal(size=(3, 15)))
    poses = wheeled.odometry(ROBOT, T, angles, slip)
    rates = np.diff(angles, axis=0) / np.diff(T)[:, None]
    twists = slip(wheeled.rolled_twists(ROBOT, rates))
    np.testing.assert_allclose(wheeled.mean_twists(T, poses), twists, atol=1e-12)


def test_without_slip_the_twist_stays_and_columns_are_derivatives():
    none = HeadingSlip.none(0.2, 3, 0)
    u = np.random.default_rng(1).normal(size=(5, 3))
    u[0] = 0.0
    np.testing.assert_allclose(none(u), u, atol=1e-15)

    def out(C):
        return none.replace(coefficients=C)(u).at[:, 2].multiply(none.arm)

    J = jax.jacfwd(out)(none.coefficients).reshape(5, 3, -1)
    np.testing.assert_allclose(none.columns(u), J, atol=1e-15)


def test_terms_are_the_harmonics_of_the_heading():
    slip = HeadingSlip.none(0.2, 5, 1, speed=0.3)
    u = np.random.default_rng(2).normal(size=3)
    s, psi = np.hypot(u[0], u[1]), np.arctan2(u[1], u[0])
    waves = [1.0] + [f(k * psi) for k in range(1, 6) for f in (np.cos, np.sin)]
    due = [0.2 * u[2], *(s * np.array(waves)), *((s / 0.3 - 1) * s * np.array(waves[:3]))]
    np.testing.assert_allclose(slip.terms(u), due, atol=1e-14)


def test_a_robot_that_turns_on_the_spot_has_finite_gradients():
    slip = HeadingSlip.none(0.2, 5, 1)
    J = jax.jit(jax.jacfwd(slip))(jnp.array([0.0, 0.0, 1.0]))
    assert np.isfinite(J).all()
    np.testing.assert_allclose(J[:, 2], [0, 0, 1], atol=1e-15)


def test_wrong_input_is_refused():
    car = wheeled.kinds()["car"].make()
    with pytest.raises(InputError, match="expected 3 of each"):
        wheeled.rolled_twists(car, [1.0, 1.0])
    with pytest.raises(InputError, match="expected a Robot"):
        wheeled.rolled_twists(1.0, [1.0, 1.0, 1.0])
    with pytest.raises(InputError, match="angles has shape"):
        wheeled.odometry(ROBOT, T, np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"expected \(3, 6\)"):
        HeadingSlip(np.zeros((3, 4)), 0.2, harmonics=2)
    with pytest.raises(InputError, match="whole numbers"):
        HeadingSlip(np.zeros((3, 4)), 0.2, harmonics=0)
