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
START, GOAL = (1.0, 0.8, 0.5), (4.0, 0.8, -0.5)


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
    ],
    ids=range(7),
)
def test_wrong_arguments(rest: dict, words: list[str]) -> None:
    given = {"grid": GRID, "footprint": SHAPE, "start": START, "goal": GOAL} | rest
    with pytest.raises((rb.InputError, rb.UnknownName)) as caught:
        plan(**given)
    for word in words:
        assert word in str(caught.value)
