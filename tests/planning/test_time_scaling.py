"""Time-optimal motions along a path: closed forms, a linear program, and the robot's own motion."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import linprog

import rbjax as rb
from rbjax.planning import Limits, Path, time_scaling

KINDS = rb.wheeled.kinds()
RADIUS, TRACK, MASS, INERTIA, WHEEL = 0.08, 0.4, 10.0, 0.4, 0.5


def cart(com: float = 0.0):
    made = KINDS["differential_drive"].make(
        track=TRACK, radius=RADIUS, mass=MASS, inertia=INERTIA, com=(com, 0.0), wheel_mass=WHEEL,
        caster=None,
    )  # fmt: skip
    return rb.wheeled.at(made, "reduced")


# by hand: wheels are discs, upright
SPIN, UPRIGHT = WHEEL * RADIUS**2 / 2, WHEEL * RADIUS**2 / 4
ALONG = MASS + 2 * WHEEL + 2 * SPIN / RADIUS**2  # kg
ABOUT = INERTIA + 2 * (UPRIGHT + (WHEEL + SPIN / RADIUS**2) * (TRACK / 2) ** 2)  # kg m^2
FORCE, MOMENT = 2 / RADIUS, TRACK / RADIUS  # of 1 N m a wheel


def trapezoid(way: float, acceleration: float, speed: float) -> float:
    """The least time from rest to rest."""
    if speed**2 / acceleration >= way:
        return 2 * np.sqrt(way / acceleration)
    return way / speed + speed / acceleration


def test_straight_and_on_the_spot_as_by_hand() -> None:
    """Bang-bang, and with a limit of speed. A step of the path ends only by chance where the torque
    changes: an error of second order in its length."""
    torque, vehicle = 0.4, cart()
    ways = np.array([[2.0, 0, 0], [-2.0, 0, 0], [0, 0, 2.0]])
    limits = np.array([np.inf, 0.7])
    steps = np.repeat(ways[:, None] / 100, 100, 1)

    def motion(steps, limit):
        limits = Limits(torque, speed=limit, turn_rate=limit)
        return time_scaling(vehicle, Path(np.zeros(3), steps), limits)

    each = jax.vmap(jax.vmap(motion, (None, 0)), (0, None))
    found = jax.jit(each)(jnp.asarray(steps), jnp.asarray(limits))
    assert found.success.all()
    for i, way in enumerate(ways):
        acceleration = torque * (MOMENT / ABOUT if way[2] else FORCE / ALONG)
        want = [trapezoid(2.0, acceleration, limit) for limit in limits]
        np.testing.assert_allclose(found.motion.time[i], want, rtol=5e-4)
        np.testing.assert_allclose(found.motion.time[i, 0], want[0], rtol=1e-12)
    assert float(jnp.abs(found.motion.controls).max()) <= torque * (1 + 1e-12)


def test_a_linear_program_finds_no_faster_motion() -> None:
    """x = s'^2 on an arc whose curvature grows: the largest sum of x within the same limits, by
    torques from equations of motion by hand; com ahead, so that turning costs torque too."""
    com, n, torque = 0.07, 24, 0.5
    curve = np.linspace(0.0, 3.0, n)
    ds = 0.1
    path = Path(np.zeros(3), np.column_stack([np.full(n, ds), np.zeros(n), curve * ds]))
    found = time_scaling(cart(com), path, Limits(torque, speed=1.0))
    # the twist by s' at both ends of each step, as `driven_path` says
    reach = TRACK / 2
    twist = np.column_stack([np.ones(n), curve]) / np.hypot(1, reach * curve)[:, None]
    size = ds * np.hypot(1, reach * curve)
    middle = (twist[1:] + twist[:-1]) / 2
    ends = np.vstack([twist[:1], middle]), np.vstack([middle, twist[-1:]])
    M = np.diag([ALONG, ABOUT + MASS * com**2])
    B = np.array([[1.0, 1.0], [-TRACK / 2, TRACK / 2]]) / RADIUS
    rows, most = [], []
    for k in range(n):
        slope = (ends[1][k] - ends[0][k]) / size[k]
        for g, at in ((ends[0][k], k), (ends[1][k], k + 1)):
            v, w = g
            turning = np.array([-MASS * com * w * w, MASS * com * v * w])  # of M nu' + ... = B tau
            by_u, by_x = np.linalg.solve(B, M @ g), np.linalg.solve(B, M @ slope + turning)
            for i in range(2):
                row = np.zeros(n + 1)
                row[k + 1] += by_u[i] / (2 * size[k])
                row[k] -= by_u[i] / (2 * size[k])
                row[at] += by_x[i]
                rows += [row, -row]
                most += [torque, torque]
    caps = (
        [0.0]
        + [1 / max(a[0], b[0]) ** 2 for a, b in zip(ends[1][:-1], ends[0][1:], strict=True)]
        + [0.0]
    )
    best = linprog(-np.ones(n + 1), rows, most, bounds=[(0, c) for c in caps])
    assert best.status == 0
    speed = np.sqrt(np.maximum(best.x, 0.0))
    time = (2 * size / (speed[1:] + speed[:-1])).sum()
    assert float(found.motion.time) == pytest.approx(time, rel=1e-7)
    driven = np.asarray(found.motion.v)[1::2, 0]  # the begins of the steps
    np.testing.assert_allclose(driven, speed[:-1] * ends[0][:, 0], atol=1e-6)


def test_a_car_on_an_arc_is_bang_bang_with_its_kinetic_energy() -> None:
    """On an arc only the speed changes: t = 2 sqrt(d m / F), m of the energy at unit speed."""
    base, track, radius, mass, inertia, com, wheel = 0.5, 0.36, 0.1, 20.0, 1.5, 0.25, 0.6
    robot = KINDS["car"].make(
        wheelbase=base, track=track, radius=radius, mass=mass, inertia=inertia, com=(com, 0.0),
        wheel_mass=wheel,
    )  # fmt: skip
    bend, way, torque = 0.8, 1.5, 0.6
    path = Path(np.zeros(3), [[way, 0.0, bend * way]]).split(0.25)
    vehicle = rb.wheeled.at(robot, "reduced")
    found = time_scaling(vehicle, path, Limits(torque, steering_rate=2.0))
    energy = mass * (1 + (com * bend) ** 2) + inertia * bend**2
    for x in (0.0, base):
        for y in (-track / 2, track / 2):
            square = (1 - bend * y) ** 2 + (bend * x) ** 2  # speed of the wheel
            energy += wheel * square * (1 + 0.5) + wheel * radius**2 / 4 * bend**2
    steer = np.arctan(bend * base) / 2.0
    want = steer + 2 * np.sqrt(way * energy / (torque / radius))
    assert float(found.motion.time) == pytest.approx(want, rel=1e-6)


@pytest.mark.slow
def test_the_robot_drives_there_with_these_torques() -> None:
    """Stops where it drives and turns; a reversal of a car; corners rounded by a sliding robot."""
    small = dict(wheelbase=0.5, track=0.36, radius=0.1, mass=20.0, inertia=1.5, com=(0.25, 0.0))
    cases = [
        (cart(0.05), [[1, 0, 0], [0, 0, 1.5], [0.5, 0, 0]], Limits(0.4, 1.0, 2.0), 0.05),
        (
            rb.wheeled.at(KINDS["car"].make(**small, wheel_mass=0.6), "reduced"),
            [[1.0, 0, 0.5], [-1.0, 0, 0.4]], Limits(1.0, 1.0, steering_rate=2.0), 0.05,
        ),
        (
            rb.wheeled.at(KINDS["omni_3"].make(), "reduced"),
            [[0.6, 0, 0], [0.3, 0.3, 0], [0, 0, 1.0]], Limits([0.2, 0.3, 0.2], 1.0), 0.03,
        ),
        (
            rb.wheeled.at(KINDS["mecanum"].make(), "reduced"),  # 4 drives, 3 velocities
            [[0.6, 0, 0], [0, 0.4, 0]], Limits(0.3, 1.0), 0.03,
        ),
    ]  # fmt: skip
    for vehicle, steps, limits, spacing in cases:
        path = Path([0.3, -0.2, 0.4], steps).split(spacing)
        motion = time_scaling(vehicle, path, limits).motion
        controls, dt = motion.sampled(600)
        drives = len(vehicle.robot.drives)
        torques = np.abs(np.asarray(controls)[:, :drives])
        assert (torques <= np.asarray(limits.torques(vehicle)) * (1 + 1e-9)).all()
        assert np.abs(controls[:, drives:]).max(initial=0) <= 2.0 * (1 + 1e-9)
        got = rb.wheeled.rollout(
            vehicle, rb.wheeled.start(vehicle, path.start), controls, dt, save_every=600
        )
        # torques are means over steps of the path, of which corners are few
        end = np.asarray(path.poses)[-1]
        assert np.hypot(*np.asarray(got.q[-1] - motion.q[-1])[:2]) < 0.02 * float(path.length)
        assert np.abs(np.asarray(motion.q[-1])[:3] - end).max() < 0.01
        assert np.abs(np.asarray(got.v[-1])).max() < 0.06


def test_derivatives_padding_and_failure() -> None:
    """t goes as the root of 1 / torque; steps of zeros change nothing; a slope too steep."""
    path = Path(np.zeros(3), [[1.0, 0.0, 0.3], [0.5, 0.0, -0.3]]).split(0.1)

    vehicle = cart(0.05)

    def time(torque, steps):
        return time_scaling(vehicle, Path(path.start, steps), Limits(torque)).motion.time

    both = jax.jit(jax.value_and_grad(time))
    value, slope = both(jnp.asarray(0.4), path.steps)
    assert float(slope) == pytest.approx(-float(value) / 2 / 0.4, rel=1e-6)
    blank = jnp.zeros((3, 3))
    padded = jnp.concatenate([path.steps[:4], blank, path.steps[4:], blank])
    assert float(both(jnp.asarray(0.4), padded)[0]) == pytest.approx(float(value), rel=1e-9)
    steep = rb.wheeled.at(cart().robot.replace(slope=jnp.array([0.5, 0.0])), "reduced")
    assert time_scaling(steep, path, Limits(0.4)).status == "infeasible"


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda p: time_scaling(cart().robot, p, Limits(1.0)), ["Robot", "reduced"]),
        (lambda p: time_scaling(cart(), None, Limits(1.0)), ["is None", "Path"]),
        (lambda p: time_scaling(cart(), p, 1.0), ["1.0", "Limits"]),
        (lambda p: time_scaling(cart(), p, Limits([1.0] * 3)), ["(3,)", "(2,)"]),
        (lambda p: Limits(0.0), ["torque", "above 0"]),
        (lambda p: Limits(np.inf), ["torque", "inf"]),
        (lambda p: Limits(1.0, speed=[1.0]), ["speed", "(1,)"]),
        (
            lambda p: time_scaling(rb.wheeled.at(KINDS["car"].make(), "dynamical"), p, Limits(1.0)),
            ["steering_rate is infinite"],
        ),
        (
            lambda p: time_scaling(
                rb.wheeled.at(KINDS["bicycle"].make(lag=0.1), "dynamical"), p, Limits(1.0)
            ),
            ["lag", "None"],
        ),
    ],
    ids=range(9),
)
def test_wrong_arguments(call, words: list[str]) -> None:
    with pytest.raises(rb.InputError) as caught:
        call(Path(np.zeros(3), [[1.0, 0.0, 0.0]]))
    for word in words:
        assert word in str(caught.value)


@pytest.mark.parametrize("dtype", [jnp.float64, jnp.float32])
def test_a_limit_of_the_steering_angle_binds(dtype: type) -> None:
    """A bicycle with a wheelbase of 1 m on a circle of 1 m steers by 45 degrees. The vehicle and
    the limits are in float64; the motion has the dtype of the path."""
    vehicle = rb.wheeled.at(KINDS["bicycle"].make(wheelbase=1.0), "reduced")
    steps = jnp.asarray([[1.57, 0, 1.57]], dtype)
    path = Path(jnp.zeros(3, dtype), steps).split(0.4)
    angles = jnp.asarray([jnp.inf, jnp.pi / 4, 0.78])  # the second is exactly at the limit

    def run(angle):
        limits = Limits(torque=50.0, speed=1.0, steering_rate=1.0, steering=angle)
        return time_scaling(vehicle, path, limits)

    found = jax.jit(jax.vmap(run))(angles)
    assert found.success.tolist() == [True, True, False]
    assert {x.dtype for x in jax.tree.leaves(found.motion)} == {jnp.dtype(dtype)}


def test_a_robot_without_steering_ignores_the_limit_of_the_angle() -> None:
    path = Path(np.zeros(3), [[0.1, 0, 0]])
    assert time_scaling(cart(), path, Limits(1.0, steering=0.1)).status == "found"
