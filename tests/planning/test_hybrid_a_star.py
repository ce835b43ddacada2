"""Hybrid A*: exact ends, free of obstacles, drivable, bounded below; named results."""

import math

import numpy as np
import pytest

import rbjax as rb
from rbjax.planning import Controls, Footprint, hybrid_a_star, reeds_shepp
from rbjax.planning.search.connections import DirectMotion
from tests.planning.scenes import bends, driven, rectangle_hits, room

SIZE = dict(ahead=0.7, behind=0.2, width=0.4)
CAR = Footprint.rectangle(**SIZE)
RADIUS = 0.8
TURN = 2 * math.pi / 72 * 3
STEER = Controls.car(RADIUS, TURN, costs=[11, 10, 11, 13, 12, 13], reversal=10, steering=1)
AHEAD = Controls([1.0] * 3, np.array([1.0, 0.0, -1.0]) / RADIUS, TURN * RADIUS)
SCENES = {
    # a gap of 1.5 m between parked cars
    "parallel parking": (room(6, 3, (0, 0, 2, 0.8), (3.5, 0, 6, 0.8)), (1, 1.8, 0), (2.4, 0.4, 0)),
    # into a dead end of 0.8 m, in which the car cannot turn about
    "dead end": (room(5, 4, (2, 0, 5, 1.5), (2, 2.3, 5, 4)), (1, 0.8, 2.0), (4.1, 1.9, math.pi)),
    "narrow gap": (room(6, 4, (2.8, 0, 3, 1.6), (2.8, 2.3, 3, 4)), (1, 0.8, 0), (5, 3.2, 3)),
}


def check(plan, grid, start, goal, radius=RADIUS) -> np.ndarray:
    """The exact ends, the motion, and that no point of the car meets an obstacle."""
    assert plan.found and plan.poses.shape == (len(plan.controls) + 1, 3)
    assert (plan.poses[0] == start).all() and (plan.poses[-1, :2] == goal[:2]).all()
    end = np.asarray(plan.path.poses)[-1]
    assert np.abs(end - plan.poses[-1]).max() <= 1e-12
    assert abs(math.remainder(end[2] - goal[2], 2 * math.pi)) <= 1e-12
    assert np.abs(np.asarray(plan.path.poses) - plan.poses).max() <= 1e-12
    assert bends(plan.path) * radius <= 1 + 1e-9
    way = driven(plan.path)
    assert np.abs(way[-1] - end).max() < 1e-3
    assert not rectangle_hits(grid, way, **SIZE)
    return way


@pytest.mark.parametrize("scene", SCENES)
def test_scenes(scene: str) -> None:
    grid, start, goal = SCENES[scene]
    plan = hybrid_a_star(grid, CAR, start, goal, STEER)
    check(plan, grid, start, goal)
    rate = 10 / (TURN * RADIUS)
    bound = float(reeds_shepp(np.array(start, float), np.array(goal, float), RADIUS).length)
    assert plan.cost >= rate * bound - 1e-9
    # the price by its definition
    steps, gear = np.asarray(plan.path.steps), np.asarray(plan.path.gears)
    side = np.sign(np.round(steps[:, 2] / steps[:, 0], 9))
    dear = {(1, 0): 10, (1, 1): 11, (1, -1): 11, (-1, 0): 12, (-1, 1): 13, (-1, -1): 13}
    keys = zip(gear, side, strict=True)
    price = sum(dear[k] * abs(s[0]) for k, s in zip(keys, steps, strict=True)) / (TURN * RADIUS)
    price += 10 * (np.diff(gear) != 0).sum() + (np.diff(side) != 0).sum()
    assert plan.cost == pytest.approx(price, abs=1e-6)
    quick = hybrid_a_star(grid, CAR, start, goal, STEER, weight=1.5)
    check(quick, grid, start, goal)
    assert quick.cost <= 1.5 * plan.cost + 1e-9


@pytest.mark.parametrize("kind", ["ahead", "spot", "omni"])
def test_other_robots(kind: str) -> None:
    """One gear; turning on the spot; sliding. Ends are exact, and steps are those of the robot."""
    grid = room(5, 4, (2, 0, 2.3, 2.0))
    start, goal = (1.0, 0.8, 0.5), (4.0, 0.8, -0.5)
    spin = 2 * math.pi / 36 / 0.15
    controls = {
        "ahead": AHEAD,
        "spot": Controls([1, -1, 0, 0], [0, 0, spin, -spin], 0.15, [3, 4, 2, 2], reversal=2),
        "omni": Controls([1, 0, 0, 0, 0], [0, 0, 0, spin, -spin], 0.15, sideways=[0, 1, -1, 0, 0]),
    }[kind]
    shape = Footprint.rectangle(0.2, 0.2, 0.3)
    plan = hybrid_a_star(grid, shape, start, goal, controls)
    assert plan.found
    way = driven(plan.path)
    steps = np.asarray(plan.path.steps)
    assert np.abs(np.asarray(plan.path.poses)[-1, :2] - goal[:2]).max() <= 1e-12
    assert not rectangle_hits(grid, way, 0.2, 0.2, 0.3)
    if kind == "ahead":
        assert (steps[:, 0] > 0).all() and bends(plan.path) * RADIUS <= 1 + 1e-9
    if kind == "spot":
        assert (steps[:, 1] == 0).all()
    moves, turns = np.abs(steps[:, :2]).max(1) > 1e-12, np.abs(steps[:, 2]) > 1e-12
    assert kind == "ahead" or not (moves & turns).any()


def test_both_roots() -> None:
    """Backwards in time from the goal is as good a path, at about the same price."""
    grid, start, goal = SCENES["narrow gap"]
    ends = [hybrid_a_star(grid, CAR, start, goal, STEER, root=r) for r in ("start", "goal")]
    for plan in ends:
        check(plan, grid, start, goal)
    assert abs(ends[0].cost - ends[1].cost) < 0.15 * ends[0].cost  # other nodes stand for cells


def test_named_results() -> None:
    grid = room(4, 3, (2, 0, 2.3, 3))
    start, goal, box = (1.0, 1.0, 0.3), (3.3, 1.5, 0.0), Footprint.disc(0.2)

    def status(start, goal, **rest) -> tuple:
        plan = hybrid_a_star(grid, box, start, goal, STEER, **rest)
        assert (plan.cost is None) == (plan.path is None) == (not plan.found)
        return plan.status, len(plan.poses), plan.expanded

    assert status(start, goal)[:2] == ("no path", 0)
    assert status((2.1, 1, 0), goal) == ("start in collision", 0, 0)
    assert status(start, (9, 1, 0)) == ("goal in collision", 0, 0)
    assert status((0.9, 2.2, 0), (1.5, 0.6, 3), max_count=1)[0] in ("count exhausted", "found")
    assert status(start, start)[0] == "found"
    tight, a, b = SCENES["narrow gap"]
    assert hybrid_a_star(tight, CAR, a, b, STEER, max_count=20).status == "count exhausted"


def test_bounds_of_direct_connections() -> None:
    """No connection is cheaper than its bound; each ends at the goal; reversed time is the same."""
    rng = np.random.default_rng(0)
    poses, goal = rng.uniform(-2, 2, (40, 3)), np.array([0.3, -0.2, 1.0])
    after = rng.integers(-1, 3, 40)
    spin = Controls([1, -1, 0, 0], [0, 0, 2, -2], 0.2, reversal=3)
    slide = Controls([1, 0, 0], [0, 0, 1], 0.2, sideways=[0, 1, 0])
    for controls in (STEER, AHEAD, AHEAD.in_reverse(), spin, slide):
        bound, steps, price = DirectMotion("test", controls)(poses, goal, after)
        assert (bound <= price + 1e-9).all()
        ends = np.asarray(rb.planning.Path(poses, steps).poses)[:, -1]
        assert np.abs(ends[:, :2] - goal[:2]).max() < 1e-12
        assert np.abs(np.exp(1j * (ends[:, 2] - goal[2])) - 1).max() < 1e-12


GRID, DISC = room(2, 2), Footprint.disc(0.1)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: hybrid_a_star(GRID, DISC, [1] * 3, [1] * 3, STEER, cell=0), ["cell is 0"]),
        (lambda: hybrid_a_star(GRID, DISC, [1] * 3, [1] * 3, STEER, weight=0.5), ["weight is 0.5"]),
        (lambda: hybrid_a_star(GRID, DISC, [1] * 3, [1] * 3, STEER, root="x"), ["root is 'x'"]),
        (
            lambda: hybrid_a_star(GRID, DISC, [1] * 3, [1] * 3, Controls([1.0], [0.0], 0.2)),
            ["cannot turn"],
        ),
        (
            lambda: hybrid_a_star(
                GRID, DISC, [1] * 3, [1] * 3, Controls([1, 1], [0, math.pi / 18], 1.0)
            ),
            ["tightest curvatures", "expected equal"],
        ),
        (lambda: Controls([1.0], [0.0], 1.0, sideways=[1, 2]), ["sideways", "1 finite"]),
        (lambda: Controls([1.0], [0.0], 1.0, steering=-1), ["steering is -1"]),
    ],
    ids=range(7),
)
def test_wrong_arguments(call, words: list[str]) -> None:
    with pytest.raises(rb.InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)
