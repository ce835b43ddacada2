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
    with pytest.raises(InputError, match="steering is None and the robot has 1 steerings"):
        wheeled.rolled_twists(car, [1.0, 1.0])
    with pytest.raises(InputError, match="expected a Robot"):
        wheeled.rolled_twists(1.0, [1.0, 1.0, 1.0])
    with pytest.raises(InputError, match="angles has shape"):
        wheeled.odometry(ROBOT, T, np.zeros((3, 3)))
    with pytest.raises(InputError, match=r"expected \(3, 6\)"):
        HeadingSlip(np.zeros((3, 4)), 0.2, harmonics=2)
    with pytest.raises(InputError, match="expected integers"):
        HeadingSlip(np.zeros((3, 4)), 0.2, harmonics=0)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("kind", [*wheeled.kinds()])
def test_odometry_of_every_kind_is_the_motion_of_its_wheels(kind, dtype):
    """A constant twist that the wheels allow: the arc, from the angles that `commands` gives."""
    robot = wheeled.kinds()[kind].make()
    v, w = 0.6, 0.25
    side = 0.2 if robot.arrangement.mobility == 3 else 0.0
    if kind == "skid_steer":
        side = -float(robot.turn_center) * w
    found = wheeled.commands(robot, [v, side, w])
    t = jnp.asarray(T, dtype)
    steering = jnp.ones((len(T), 1), dtype) * found.angles.astype(dtype) if len(
        found.angles
    ) else None  # fmt: skip
    angles = (0.3 + t[:, None] * found.speeds).astype(dtype)
    poses = wheeled.odometry(robot, t, angles, steering=steering, pose=[1.0, 2.0, 0.5])
    s, c = np.sin(w * T), np.cos(w * T)
    ahead = np.stack([s * v - (1 - c) * side, (1 - c) * v + s * side], -1) / w
    turn = np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
    atol = 1e-12 if dtype == jnp.float64 else 1e-5
    assert poses.dtype == dtype
    np.testing.assert_allclose(poses[:, :2], [1.0, 2.0] + ahead @ turn.T, rtol=0, atol=atol)
    np.testing.assert_allclose(poses[:, 2], 0.5 + w * T, rtol=0, atol=atol)


def test_odometry_follows_a_car_that_steers():
    """Against a rollout of the car, whose steering changes: an error of second order in time."""
    robot = wheeled.kinds()["car"].make(wheelbase=2.0, motor=wheeled.SpeedServo(1.0))
    car = wheeled.at(robot, "kinematic")
    off = []
    for n in (25, 50):
        dt = 2.0 / n
        rate = 0.3 * np.cos(2 * (np.arange(n) + 0.5) * dt)
        u = jnp.asarray(np.stack([np.full(n, 4.0), rate], -1))
        path = wheeled.rollout(car, wheeled.start(car), u, dt)
        layout = robot.layout
        shafts = path.q[:, layout.shafts]
        cage = (shafts[:, layout.shaft[0]] + shafts[:, layout.shaft[1]]) / 2
        steering = path.q[:, layout.steerings]
        poses = wheeled.odometry(robot, path.ts, cage[:, None], steering=steering)
        off.append(float(jnp.abs(poses - path.q[:, :3]).max()))
    assert off[1] < 2e-3 and 3 < off[0] / off[1] < 5


def test_equal_stamps_do_no_harm_without_slip():
    t, rates = np.array([0.0, 0.1, 0.1, 0.2]), np.array([3.0, 1.0, 2.0])
    angles = np.array([0.0, 0.1, 0.1, 0.2])[:, None] * rates
    poses = wheeled.odometry(ROBOT, t, angles)
    kept = wheeled.odometry(ROBOT, t[[0, 1, 3]], angles[[0, 1, 3]])
    np.testing.assert_allclose(np.asarray(poses)[[0, 1, 3]], kept, atol=1e-15)
    slip = HeadingSlip.none(0.2)
    with pytest.raises(InputError, match=r"t\[2\] is 0.1 after 0.1, expected times that increase"):
        wheeled.odometry(ROBOT, t, angles, slip)
    with pytest.raises(InputError, match=r"t\[2\] is 0.1 after 0.1"):
        wheeled.mean_twists(t, poses)
    with pytest.raises(InputError, match=r"t\[1\] is 0.1 after 0.2, expected times that do not"):
        wheeled.odometry(ROBOT, t[::-1], angles)
    traced = jax.jit(lambda t: wheeled.odometry(ROBOT, t, angles, slip))(jnp.asarray(t))
    np.testing.assert_allclose(traced, poses, atol=1e-12)


def test_what_angles_do_not_determine_is_refused():
    car, cart = (wheeled.kinds()[k].make() for k in ("car", "differential_drive"))
    with pytest.raises(InputError, match="steering is None and the robot has 1 steerings"):
        wheeled.odometry(car, T, np.zeros((4, 1)))
    with pytest.raises(InputError, match="steering is given and the robot has 0 steerings"):
        wheeled.odometry(cart, T, np.zeros((4, 2)), steering=np.zeros((4, 0)))
    with pytest.raises(InputError, match="steering has shape"):
        wheeled.odometry(car, T, np.zeros((4, 1)), steering=np.zeros((4, 2)))
    idle = cart.replace(drives=cart.drives[:1])
    with pytest.raises(InputError, match="2 velocities free and 1 are driven"):
        wheeled.odometry(idle, T, np.zeros((4, 1)))
    with pytest.raises(InputError, match=r"slip is 0\.1"):
        wheeled.odometry(cart, T, np.zeros((4, 2)), 0.1)
