"""Refined motions: closed forms, replays in fine steps among obstacles, and what may fail."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.planning import Footprint, Limits, Path, plan, refine
from tests.planning.scenes import rectangle_hits, room
from tests.planning.test_time_scaling import ABOUT, ALONG, FORCE, KINDS, MOMENT, cart

TORQUE = 0.4


def overshoot(ahead: int, back: int, turns: bool) -> Path:
    """Steps of 0.1 m, or rad, ahead and then back."""
    steps = np.zeros((ahead + back, 3))
    steps[:, 2 if turns else 0] = np.repeat([0.1, -0.1], [ahead, back])
    return Path(np.zeros(3), steps)


@pytest.mark.slow
def test_an_overshoot_becomes_bang_bang() -> None:
    """t = 2 sqrt(d m / F): from a path that goes too far and back, for driving and for turning on
    the spot; a straight path stays as it was."""
    cases = [(13, 3, False, ALONG / FORCE), (13, 3, True, ABOUT / MOMENT),
             (10, 0, False, ALONG / FORCE)]  # fmt: skip
    vehicle = cart()
    for ahead, back, turns, inertia in cases:
        path = overshoot(ahead, back, turns)
        blank = jnp.zeros((16 - len(path.steps), 3))
        path = Path(path.start, jnp.concatenate([path.steps, blank]))
        found = refine(vehicle, path, Limits(TORQUE), intervals=16, iterations=40, parts=1)
        best = 2 * np.sqrt(inertia / TORQUE)
        assert found.status == ("refined" if back else "as it was")
        assert float(found.motion.time) == pytest.approx(best, rel=1e-3)
        assert float(found.motion.time) > best * (1 - 1e-3)
        assert float(found.start_time) > (1.2 if back else 1) * best * (1 - 1e-9)
        assert float(jnp.abs(found.motion.controls).max()) <= TORQUE * (1 + 1e-12)


GRID = room(5, 4, (2, 0, 2.3, 2.0))
BOX = dict(ahead=0.3, behind=0.2, width=0.3)
SIZE = dict(ahead=0.7, behind=0.2, width=0.4)
GAP = room(6, 4, (2.8, 0, 3, 1.6), (2.8, 2.3, 3, 4))
ENDS = (1.0, 0.8, 0.5), (4.0, 0.8, -0.5)


def scene(name: str):
    """A vehicle, its limits, a map, its rectangle, a plan's path; how much time is to be gained."""
    if name == "car":
        robot = KINDS["car"].make(
            wheelbase=0.5, track=0.36, radius=0.1, mass=20.0, inertia=1.5, com=(0.25, 0.0),
            wheel_mass=0.5,
        )  # fmt: skip
        shape = Footprint.rectangle(**SIZE)
        found = plan(GAP, shape, (1, 0.8, 0), (5, 3.2, 3), radius=0.8)
        limits, gain = Limits(2.0, 2.0, steering_rate=1.5), 0.15
        return rb.wheeled.at(robot, "reduced"), limits, GAP, SIZE, found.path, gain
    shape = Footprint.rectangle(**BOX)
    if name == "omni":
        vehicle, drive = rb.wheeled.at(KINDS["omni_3"].make(), "reduced"), "omnidirectional"
        limits = Limits(0.2, 1.0, 2.0)
    else:
        vehicle, drive, limits = cart(0.07), "differential", Limits(TORQUE, 1.0, 2.0)
    found = plan(GRID, shape, *ENDS, drive=drive)
    return vehicle, limits, GRID, BOX, found.path.split(0.1), 0.4


@pytest.mark.slow
@pytest.mark.parametrize("name", ["car", "cart", "omni"])
def test_the_robot_is_there_sooner_and_clear(name: str) -> None:
    """Open loop, by `rollout` in fine steps: within 1 cm and half a degree, at rest, off obstacles,
    limits of rates within 0.2 %, torques and steering rates exactly; well before the start."""
    vehicle, limits, grid, box, path, gain = scene(name)
    got = refine(vehicle, path, limits, grid.distance_field(), Footprint.rectangle(**box))
    assert got.status == "refined", got.residuals
    assert float(got.motion.time) < (1 - gain) * float(got.start_time)
    drives = len(vehicle.robot.drives)
    controls = np.abs(np.asarray(got.motion.controls))
    assert (controls[:, :drives] <= np.asarray(limits.torques(vehicle)) * (1 + 1e-6)).all()
    assert controls[:, drives:].max(initial=0) <= float(limits.steering_rate) * (1 + 1e-6)
    u, dt = got.motion.sampled(4000)
    run = rb.wheeled.rollout(vehicle, rb.wheeled.start(vehicle, path.start), u, dt, save_every=10)
    off = np.asarray(run.q[-1, :3] - path.poses[-1])
    assert np.hypot(*off[:2]) < 0.01 and abs(off[2]) < np.deg2rad(0.5)
    assert np.abs(np.asarray(run.v[-1])).max() < 0.01
    poses = np.asarray(run.q[:, :3])
    assert not rectangle_hits(grid, poses, **box)
    speed = np.hypot(*np.diff(poses[:, :2], axis=0).T) / (10 * float(dt))
    turning = np.abs(np.diff(poses[:, 2])) / (10 * float(dt))
    assert speed.max() <= float(limits.speed) * 1.002
    assert turning.max() <= float(limits.turn_rate) * 1.002
    if drives == 1:
        steering = np.asarray(run.q[:, vehicle.robot.layout.steerings])
        assert np.abs(np.tan(steering)).max() <= 0.5 / 0.8 * 1.01  # the plan's turning radius


@pytest.mark.slow
def test_many_at_once_and_another_fidelity() -> None:
    """`vmap` is one after the other; the dynamical fidelity gives the same motion."""
    vehicle, limits = cart(0.05), Limits(TORQUE, 1.0)
    corners = np.array([[[0.6, 0, 0], [0, 0, a], [0.6, 0, 0]] for a in (1.5, -0.8)])
    steps = jnp.asarray(np.repeat(corners / 8, 8, 1))
    few = dict(intervals=24, iterations=8)
    run = jax.jit(jax.vmap(lambda s: refine(vehicle, Path(jnp.zeros(3), s), limits, **few)))
    many = run(steps)
    for i, x in enumerate(steps):
        for fidelity in ("reduced", "dynamical"):
            same = rb.wheeled.at(vehicle.robot, fidelity)
            one = refine(same, Path(jnp.zeros(3), x), limits, **few)
            assert one.status == "refined"
            assert float(many.motion.time[i]) == pytest.approx(float(one.motion.time), rel=1e-4)


@pytest.mark.slow
def test_a_trailer_and_a_caster_come_along() -> None:
    """Their angles are states of the motion; a caster takes short steps."""
    trailer = rb.wheeled.at(KINDS["car_trailer"].make(), "reduced")
    bends = Path(np.zeros(3), [[10.0, 0.0, 1.5], [8.0, 0.0, -1.0]]).split(0.5)
    caster = rb.wheeled.at(KINDS["differential_drive"].make(), "reduced")
    corner = Path(np.zeros(3), [[0.5, 0, 0], [0, 0, 1.2], [0.5, 0, 0]]).split(0.1)
    cases = [
        (trailer, bends, Limits(600.0, 5.0, steering_rate=0.5), 2),
        (caster, corner, Limits(TORQUE, 1.0, 2.0), 10),
    ]
    for vehicle, path, limits, parts in cases:
        got = refine(vehicle, path, limits, intervals=40, iterations=25, parts=parts)
        assert got.status == "refined", got.residuals
        assert float(got.motion.time) < 0.8 * float(got.start_time)
        u, dt = got.motion.sampled(8000)
        begin = rb.wheeled.start(vehicle, path.start)
        run = rb.wheeled.rollout(vehicle, begin, u, dt, save_every=8000)
        off = np.asarray(run.q[-1] - got.motion.q[-1])[: vehicle.robot.layout.casters.start]
        assert np.abs(off).max() < 0.005
        assert np.abs(np.asarray(run.q[-1, :3] - path.poses[-1])).max() < 0.01


@pytest.mark.slow
def test_derivatives_of_the_time() -> None:
    """By torque and by speed, through the whole search, against differences."""
    vehicle = cart(0.05)
    corner = Path(np.zeros(3), [[1.0, 0, 0], [0, 0, 1.5], [1.0, 0, 0]]).split(0.2)

    def time(x):
        limits = Limits(x[0], speed=x[1])
        return refine(vehicle, corner, limits, intervals=20, iterations=60).motion.time

    at, h = jnp.array([0.4, 1.0]), 1e-3
    slopes, value = jax.jit(jax.jacfwd(time))(at), jax.jit(time)
    for i, step in enumerate(h * np.eye(2)):
        want = float(value(at + step) - value(at - step)) / (2 * h)
        assert float(slopes[i]) == pytest.approx(want, rel=2e-3)  # it is an optimum to 1e-3


@pytest.mark.slow
def test_failures_are_results() -> None:
    """No motion holds the limits on a steep slope; a wall across the path is never crossed."""
    steep = rb.wheeled.at(cart().robot.replace(slope=jnp.array([0.5, 0.0])), "reduced")
    path = overshoot(10, 0, False)
    few = dict(intervals=12, iterations=5)
    assert refine(steep, path, Limits(TORQUE), **few).status == "infeasible"
    wall = room(4, 2, (2, 0, 2.1, 2)).distance_field()
    across = Path([1.5, 1.0, 0.0], path.steps)
    got = refine(cart(), across, Limits(TORQUE), wall, Footprint.disc(0.2), **few)
    assert got.status == "not converged" and not bool(got.residuals.free)


@pytest.mark.parametrize(
    ("rest", "words"),
    [
        (dict(field=GRID.distance_field()), ["only one of field and footprint"]),
        (dict(field=GRID, footprint=Footprint.disc(0.2)), ["OccupancyGrid", "DistanceField"]),
        (dict(intervals=0), ["intervals is 0", "integer of at least 1"]),
        (dict(model=rb.wheeled.at(cart().robot, "kinematic")), ["Kinematic", "reduced"]),
        (dict(path=Path(np.zeros((2, 3)), np.zeros((2, 4, 3)))), ["(2, 4, 3)", "jax.vmap"]),
    ],
    ids=range(5),
)
def test_wrong_arguments(rest: dict, words: list[str]) -> None:
    given = dict(model=cart(), path=overshoot(3, 0, False), limits=Limits(1.0)) | rest
    with pytest.raises(rb.InputError) as caught:
        refine(**given)
    for word in words:
        assert word in str(caught.value)
