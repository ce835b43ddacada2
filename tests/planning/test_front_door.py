"""`plan`: every drive and method, batches, named results."""

import math

import numpy as np
import pytest

import rbjax as rb
from rbjax.planning import Footprint, drives, methods, plan
from tests.planning.scenes import bends, driven, rectangle_hits, room

GRID = room(5, 4, (2, 0, 2.3, 2.0))
BOX = dict(ahead=0.3, behind=0.2, width=0.3)
SHAPE = Footprint.rectangle(**BOX)
KINDS = rb.wheeled.kinds()
START, GOAL = (1.0, 0.8, 0.5), (4.0, 0.8, -0.5)
SMALL = dict(wheelbase=0.4, radius=0.05)
BICYCLE = KINDS["bicycle"].make(**SMALL)


@pytest.mark.parametrize("drive", drives())
def test_drives(drive: str) -> None:
    radius = {"radius": 0.6} if drive == "car" else {}
    got = plan(GRID, SHAPE, START, GOAL, drive=drive, **radius)
    assert got.found and got.refinement == ("smoothed" if drive == "car" else "none")
    end = np.asarray(got.path.poses)[-1]
    assert np.abs(end[:2] - GOAL[:2]).max() < 1e-11
    assert abs(math.remainder(end[2] - GOAL[2], 2 * math.pi)) < 1e-11
    assert not rectangle_hits(GRID, driven(got.path), **BOX)
    if drive == "car":
        assert bends(got.path) * 0.6 <= 1 + 1e-9
        ahead = plan(GRID, SHAPE, START, GOAL, radius=0.6, backwards=False, smoothed=False)
        assert ahead.found and (np.asarray(ahead.path.gears) > 0).all()
        assert ahead.refinement == "none"


@pytest.mark.parametrize("kind", [name for name, x in KINDS.items() if "trailer" not in name])
def test_a_robot_has_a_drive_a_radius_and_a_footprint(kind: str) -> None:
    """Along its plan no wheel slides sideways, no steering exceeds its limit, and the wheels are
    clear of walls."""
    steers = kind in ("car", "front_drive_car", "bicycle", "tricycle")
    robot = KINDS[kind].make(**SMALL if steers else {})
    if steers and kind != "bicycle":
        robot = KINDS[kind].make(track=0.3, **SMALL)
    got = plan(GRID, robot, START, GOAL, steering=0.7, smoothed=False)
    assert got.found
    most = np.abs([sideways(robot, twist, 0.7) for twist in np.asarray(got.path.steps)]).max()
    assert most < 1e-9
    reach = [float(w.radius) + float(w.trail) * (w.kind == "caster") for w in robot.wheels]
    x, y = np.array([np.asarray(w.position) for w in robot.wheels]).T
    box = dict(ahead=(x + reach).max(), behind=(reach - x).max(), width=2 * (abs(y) + reach).max())
    assert not rectangle_hits(GRID, driven(got.path), **box)


def sideways(robot: rb.wheeled.Robot, twist: np.ndarray, most: float) -> float:
    """The largest sideways velocity of the wheels that hold the chassis, per speed of the wheel.
    The angle of a steering is at most `most`."""
    held = [([i], 0.0) for i, w in enumerate(robot.wheels) if w.kind == "fixed" and not w.skids]
    held += [(steering.wheels, most) for steering in robot.steerings]
    out = [0.0]
    for wheels, limit in held:
        x, y = np.mean([np.asarray(robot.wheels[i].position) for i in wheels], 0)
        u = np.array([twist[0] - twist[2] * y, twist[1] + twist[2] * x])
        angle = math.atan(u[1] / u[0]) if u.any() else 0.0
        slip = angle - np.clip(angle, -limit, limit)
        out.append(abs(math.sin(slip)) if np.hypot(*u) > 1e-12 else 0.0)
    return max(out)


def test_a_footprint_of_its_own_and_the_robot_s_radius() -> None:
    found = plan(GRID, BICYCLE, START, GOAL, footprint=SHAPE, steering=0.5, smoothed=False)
    same = plan(GRID, SHAPE, START, GOAL, radius=0.4 / math.tan(0.5), smoothed=False)
    assert found.found and (found.poses == same.poses).all()


@pytest.mark.parametrize("method", methods())
def test_methods_and_batches(method: str) -> None:
    """Many at once are one after the other; a place in an obstacle is one plan's status."""
    goals = np.array([GOAL, (2.1, 1.0, 0.0), (4.0, 3.0, 1.0)])
    rest = dict(radius=0.6, method=method, smoothed=False)
    got = plan(GRID, SHAPE, START, goals, **rest)
    assert [p.status for p in got] == ["found", "goal in collision", "found"]
    for one, goal in zip(got, goals, strict=True):
        alone = plan(GRID, SHAPE, START, goal, **rest)
        assert (alone.status, alone.cost, alone.expanded) == (one.status, one.cost, one.expanded)
        assert (alone.poses == one.poses).all()
        if one.found:
            assert np.hypot(*(np.asarray(one.path.poses)[-1] - goal)[:2]) <= 0.1
    assert plan(GRID, SHAPE, START, GOAL, radius=0.6, method=method, max_count=5).status == (
        "count exhausted"
    )


@pytest.mark.parametrize(
    ("rest", "words"),
    [
        (dict(method="rrt", radius=1.0), ["method 'rrt'", "'hybrid_a_star'"]),
        (dict(drive="tank"), ["drive 'tank'", "'differential'"]),
        (dict(), ["radius is None", "above zero"]),
        (dict(drive="differential", radius=1.0), ["radius is 1.0", "none"]),
        (dict(radius=-1.0), ["radius is -1.0"]),
        (dict(radius=1.0, start=[0.0, 1.0]), ["shapes (2,) and (3,)", "(q, 3)"]),
        (dict(radius=1.0, grid=None), ["grid is None", "OccupancyGrid"]),
        (dict(robot="car"), ["robot is 'car'", "rb.wheeled.Robot or rb.planning.Footprint"]),
        (dict(robot=KINDS["car_trailer"].make()), ["has trailers", "a Footprint"]),
        (dict(robot=BICYCLE, steering=2.0), ["steering is 2.0", "up to 1.5 rad"]),
        (dict(robot=KINDS["skid_steer"].make().replace(turn_center=0.1)), ["fits no drive"]),
    ],
    ids=range(11),
)
def test_wrong_arguments(rest: dict, words: list[str]) -> None:
    given = {"grid": GRID, "robot": SHAPE, "start": START, "goal": GOAL} | rest
    with pytest.raises((rb.InputError, rb.UnknownName)) as caught:
        plan(**given)
    for word in words:
        assert word in str(caught.value)
