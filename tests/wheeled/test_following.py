"""Following paths: geometry by hand, and closed loops on robots whose wheels slip."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rbjax import wheeled
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.wheeled import DCMotor, Fiala, SpeedServo

KINDS = wheeled.kinds()


def circle(radius: float, turn: float = 2 * np.pi, n: int = 400) -> jnp.ndarray:
    """To the left from the origin, ahead."""
    a = np.linspace(0, turn, n)
    return jnp.array(np.stack([radius * np.sin(a), radius * (1 - np.cos(a)), a], -1))


def from_circle(radius: float, q) -> np.ndarray:
    return np.hypot(q[..., 0], q[..., 1] - radius) - radius


@pytest.mark.parametrize("kind", list(KINDS))
def test_commands_are_what_the_kinematic_robot_obeys(kind) -> None:
    """Shafts at these speeds and steerings at these angles move the chassis by the twist."""
    robot = KINDS[kind].make(motor=SpeedServo(1.0))
    twist = np.array([0.8, 0.3 if robot.arrangement.mobility == 3 else 0.0, 0.25])
    found = wheeled.commands(robot, twist)
    base = wheeled.at(robot, "kinematic")
    steerings = robot.layout.steerings
    q = jnp.zeros(base.nq).at[steerings].set(found.angles)
    u = jnp.concatenate([found.speeds, jnp.zeros(len(robot.steerings))])
    rate = wheeled.rates(base, State(q, jnp.zeros(0)), u)
    np.testing.assert_allclose(rate.q[:3], twist, atol=1e-12)


def test_pure_pursuit_on_its_circle_turns_with_its_radius() -> None:
    """The arc through a point of a circle that one is on is that circle."""
    path = circle(2.0, n=20000)
    twist = wheeled.pure_pursuit(path, path[5000], 0.6, 0.5)
    np.testing.assert_allclose(twist, [0.6, 0.0, 0.3], rtol=1e-5, atol=1e-9)
    beyond = wheeled.pure_pursuit(circle(2.0, 1.0), circle(2.0, 1.0)[-1], 0.6, 0.5)
    np.testing.assert_allclose(beyond[2], 0.0, atol=1e-9)  # it goes on straight


def test_stanley_on_a_straight_is_its_formula() -> None:
    path = jnp.stack([jnp.linspace(0, 50, 100), jnp.zeros(100), jnp.zeros(100)], -1)
    twist = wheeled.stanley(path, [1.0, 0.4, 0.1], 3.0, 2.6, gain=0.8, soft=0.5)
    e = -(0.4 + 2.6 * np.sin(0.1))
    angle = -0.1 + np.arctan2(0.8 * e, 3.5)
    np.testing.assert_allclose(twist, [3.0, 0.0, 3.0 * np.tan(angle) / 2.6], rtol=1e-12)


def test_pure_pursuit_holds_a_slipping_cart_on_a_circle() -> None:
    motor = SpeedServo(2.0)
    robot = KINDS["differential_drive"].make(caster=None, motor=motor, wheel_mass=2.0)
    cart = wheeled.at(robot, "slipping", tyre=Fiala(20.0, 0.8, smooth_speed=0.3))
    path = circle(1.5)

    def control(t, state):
        return wheeled.commands(robot, wheeled.pure_pursuit(path, state.q[:3], 0.5, 0.3)).speeds

    start = wheeled.start(cart, pose=[0.0, -0.2, 0.0])
    found = wheeled.rollout(cart, start, control, 0.002, steps=4000, save_every=400)
    assert found.success
    off = from_circle(1.5, np.asarray(found.q))
    assert off[0] > 0.15 and np.abs(off[4:]).max() < 0.03
    assert np.abs(np.diff(found.q[:, 2]))[3:].min() > 0.1  # it drives on


def test_stanley_holds_a_slipping_car_on_a_circle() -> None:
    robot = KINDS["bicycle"].make(motor=SpeedServo(2000.0), lag=0.1)
    car = wheeled.at(robot, "slipping", tyre=Fiala(15.0, 0.9, smooth_speed=1.0))
    path = circle(20.0)

    def control(t, state):
        wanted = wheeled.commands(robot, wheeled.stanley(path, state.q[:3], 5.0, 2.6))
        return jnp.concatenate([wanted.speeds, wanted.angles])

    start = wheeled.start(car, pose=[0.0, -1.0, 0.0], twist=[5.0, 0.0, 0.0])
    found = wheeled.rollout(car, start, control, 0.002, steps=6000, save_every=500)
    assert found.success
    ends = np.asarray(found.q)
    front = ends[:, :2] + 2.6 * np.stack([np.cos(ends[:, 2]), np.sin(ends[:, 2])], -1)
    off = from_circle(20.0, front)
    assert off[0] > 0.8 and np.abs(off[6:]).max() < 0.25


@pytest.mark.slow
def test_a_regulator_brings_a_slipping_cart_back_to_its_trajectory() -> None:
    """Gains of the rolling model, used on the slipping one, whose start is off."""
    robot = KINDS["differential_drive"].make(caster=None, wheel_mass=2.0)
    ideal = wheeled.at(robot, "reduced")
    slips = wheeled.at(robot, "slipping", tyre=Fiala(40.0, 0.8, smooth_speed=0.3))
    dt, steps, n = 0.01, 400, ideal.nq
    u = jnp.tile(jnp.array([0.03, 0.02]), (steps, 1))
    due = wheeled.rollout(ideal, wheeled.start(ideal, twist=[0.4, 0.0, 0.2]), u, dt)
    Q = jnp.array([10.0, 10.0, 5.0, 0.0, 0.0, 1.0, 1.0])
    K = wheeled.tracking_gains(ideal, State(due.q, due.v), u, dt, Q, 5.0 * jnp.ones(2))
    z = jnp.concatenate([due.q, due.v], -1)

    def follow(feedback: bool):
        def control(t, state):
            k = jnp.clip(jnp.round(t / dt).astype(int), 0, steps - 1)
            seen = jnp.concatenate([state.q[:n], state.v[0:1], state.v[2:3]])
            return u[k] - (K[k] @ (seen - z[k]) if feedback else 0.0)

        start = wheeled.start(slips, pose=[0.05, -0.1, 0.1], twist=[0.4, 0.0, 0.2])
        return wheeled.rollout(slips, start, control, dt / 5, steps=5 * steps, save_every=500)

    ends = [np.abs(follow(x).q[-1, :3] - due.q[-1, :3]) for x in (True, False)]
    assert ends[0].max() < 0.05 < 0.1 < ends[1].max()


@pytest.mark.slow
def test_gains_of_a_steady_motion_are_those_of_the_algebraic_equation() -> None:
    """Long before the end the gains satisfy P = Q + A^T P (A - B K), here by SciPy."""
    import jax
    import scipy.linalg

    robot = KINDS["omni_3"].make()
    base = wheeled.at(robot, "reduced")
    dt, steps = 0.05, 300
    rest = State(jnp.zeros((steps + 1, 6)), jnp.zeros((steps + 1, 3)))
    Q, R = jnp.array([1.0, 1.0, 1.0, 0, 0, 0, 0.1, 0.1, 0.1]), jnp.ones(3)
    K = wheeled.tracking_gains(base, rest, jnp.zeros((steps, 3)), dt, Q, R)[0]

    def step(z, u):
        path = wheeled.rollout(base, State(z[:6], z[6:]), u[None], dt)
        return jnp.concatenate([path.q[-1], path.v[-1]])

    A, B = jax.jacfwd(step, (0, 1))(jnp.zeros(9), jnp.zeros(3))
    seen = np.array([0, 1, 2, 6, 7, 8])  # the angles of the wheels neither count nor act
    A, B = np.asarray(A)[np.ix_(seen, seen)], np.asarray(B)[seen]
    P = scipy.linalg.solve_discrete_are(A, B, np.diag(np.asarray(Q)[seen]), np.diag(R))
    due = np.linalg.solve(np.diag(R) + B.T @ P @ B, B.T @ P @ A)
    np.testing.assert_allclose(K[:, seen], due, atol=1e-6)


def test_bad_arguments_are_named() -> None:
    with pytest.raises(InputError, match="path has shape"):
        wheeled.pure_pursuit(jnp.zeros((5, 2)), jnp.zeros(3), 1.0, 1.0)
    with pytest.raises(InputError, match="expected a Robot"):
        wheeled.commands(None, jnp.zeros(3))


STRAIGHT = np.stack([np.linspace(0, 5, 101), np.zeros(101), np.zeros(101)], -1)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_pure_pursuit_mirrors_and_stops(sign: float, dtype: type) -> None:
    """Backwards along a path is forwards along the path seen from behind; both stop at its end."""
    path = jnp.asarray(STRAIGHT * [sign, 1, 1], dtype)
    for x in (0.0, 3.0, 4.4, 4.5, 4.6, 4.99):
        pose = jnp.asarray([sign * x, 0.1, 0.05 * sign], dtype)
        v, across, w = wheeled.pure_pursuit(path, pose, sign, 1.0)
        ahead = np.hypot(1.0, 0.1)
        angle = np.arctan2(-0.1, 1.0) - 0.05
        assert (v, across) == (sign, 0.0)
        np.testing.assert_allclose(w, sign * 2 * np.sin(angle) / ahead, rtol=1e-5)
    for x in (5.0, 5.1, 7.0):
        assert wheeled.pure_pursuit(path, [sign * x, 0.1, 0.0], sign, 1.0).tolist() == [0, 0, 0]


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_pure_pursuit_drives_to_the_goal_and_stands(sign: float) -> None:
    a = np.linspace(0, 1.5, 200)
    path = jnp.asarray(np.stack([sign * 2 * np.sin(a), 2 * (1 - np.cos(a)), sign * a], -1))
    pose, dt = np.array([0.0, 0.15, 0.1]), 0.02
    for _ in range(260):
        v, _, w = np.asarray(wheeled.pure_pursuit(path, pose, 0.7 * sign, 0.5))
        pose = pose + dt * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), w])
    np.testing.assert_allclose(pose, path[-1], rtol=0, atol=0.05)
    assert not wheeled.pure_pursuit(path, pose, sign, 0.5).any()


def test_pure_pursuit_where_the_path_comes_back_is_bounded() -> None:
    """The point ahead is where the robot is: a cusp half a lookahead ahead."""
    there = np.concatenate([STRAIGHT, STRAIGHT[::-1]])
    twist = wheeled.pure_pursuit(there, [4.5, 0.001, 0.0], 1.0, 1.0)
    assert np.abs(twist[2]) < 1.0
    assert wheeled.pure_pursuit(STRAIGHT * 0, [0.0, 0.1, 0.0], 1.0, 1.0).tolist() == [0, 0, 0]


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_stanley_stops_and_takes_no_reverse(dtype: type) -> None:
    path = jnp.asarray(STRAIGHT, dtype)
    assert wheeled.stanley(path, [4.9, 0.1, 0.0], 1.0, 2.0)[0] == 1.0
    assert wheeled.stanley(path, [5.0, 0.1, 0.0], 1.0, 2.0).tolist() == [0, 0, 0]
    traced = jax.jit(lambda v: wheeled.stanley(path, jnp.zeros(3, dtype), v, 2.0))
    assert traced(jnp.asarray(-1.0, dtype)).tolist() == [0, 0, 0]
    with pytest.raises(InputError, match="pure_pursuit takes speeds below zero"):
        wheeled.stanley(path, [0.0, 0.1, 0.0], -1.0, 2.0)


def test_a_gradient_on_the_path_is_finite() -> None:
    for law in (
        lambda p: wheeled.pure_pursuit(STRAIGHT, p, 1.0, 1.0),
        lambda p: wheeled.stanley(STRAIGHT, p, 1.0, 2.0),
    ):
        for pose in ([0.0, 0.0, 0.0], [2.5, 0.0, 0.0], [5.0, 0.0, 0.0], [6.0, 0.1, 0.0]):
            assert np.isfinite(jax.jacrev(law)(jnp.array(pose))).all()


@pytest.mark.parametrize(
    "call, message",
    [
        (lambda: wheeled.pure_pursuit(STRAIGHT, np.zeros(3), 1.0, 0.0), "lookahead is 0.0"),
        (lambda: wheeled.pure_pursuit(STRAIGHT, np.zeros(3), 1.0, -1.0), "above zero"),
        (lambda: wheeled.pure_pursuit(STRAIGHT, np.zeros(3), np.nan, 1.0), "speed is nan"),
        (lambda: wheeled.pure_pursuit(STRAIGHT, np.zeros(3), "fast", 1.0), "speed is .fast."),
        (lambda: wheeled.stanley(STRAIGHT, np.zeros(3), 1.0, 0.0), "wheelbase is 0.0"),
        (lambda: wheeled.stanley(STRAIGHT, np.zeros(3), 1.0, 1.0, gain=np.nan), "gain is nan"),
        (lambda: wheeled.stanley(STRAIGHT, np.zeros(3), 1.0, 1.0, soft=-1.0), "soft is -1.0"),
    ],
)
def test_numbers_out_of_range_are_refused(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call()


def test_commands_become_controls_in_the_unit_of_the_motor() -> None:
    """Held without load, the robot drives as it was asked to; torques are no speeds."""
    twist = np.array([0.6, 0.0, 0.4])
    make = KINDS["differential_drive"].make
    for motor in (SpeedServo(0.5), DCMotor(2.0, 0.05, gear=20.0), DCMotor(
        2.0, 0.05, gear=20.0, battery=24.0, friction=0.01
    )):  # fmt: skip
        robot = make(motor=motor, caster=None)
        found = wheeled.commands(robot, twist)
        u = found.controls(robot)
        np.testing.assert_allclose(motor.free_speed(u), found.speeds, rtol=1e-12)
    slow = DCMotor(2.0, 0.05, gear=20.0, battery=1.0)
    u = wheeled.commands(make(motor=slow), twist).controls(make(motor=slow))
    np.testing.assert_allclose(u, 3.0, rtol=1e-9)  # all that a battery of 1 V has
    with pytest.raises(InputError, match=r"TorqueSource has no free speed.*SpeedServo"):
        wheeled.commands(make(), twist).controls(make())
    car = KINDS["car"].make(motor=SpeedServo(1.0))
    with pytest.raises(InputError, match=r"steerings.0. has no lag"):
        wheeled.commands(car, twist).controls(car)
    lagging = KINDS["car"].make(motor=SpeedServo(1.0), lag=0.1)
    found = wheeled.commands(lagging, twist)
    np.testing.assert_allclose(found.controls(lagging), [*found.speeds, *found.angles])
