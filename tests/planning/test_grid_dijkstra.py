"""The planner against Algorithm 10.2 as it is printed (algorithm_10_2.py), and against geometry."""

import math

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases import algorithm_10_2
from rbjax.planning import (
    Controls,
    Footprint,
    OccupancyGrid,
    Plan,
    grid_dijkstra,
    reeds_shepp,
)
from rbjax.planning.search.controls import MotionTable

CAR = Footprint.rectangle(ahead=0.41, behind=0.13, width=0.32, discs=3)


def cluttered(n: int, seed: int, boxes: int, size: int = 4) -> OccupancyGrid:
    """A square map of cells of 0.1 m with random boxes; its middle and a corner are free."""
    rng = np.random.default_rng(seed)
    cells = np.zeros((n, n), bool)
    for _ in range(boxes):
        i, j = rng.integers(0, n, 2)
        w, l = rng.integers(1, size, 2)
        cells[i : i + w, j : j + l] = True
    cells[:12, :12] = cells[n // 2 - 6 : n // 2 + 6, n // 2 - 6 : n // 2 + 6] = False
    return OccupancyGrid(cells, 0.1, [-1.03, 0.57])


def car_like(headings: int, times: int = 1, **rest) -> Controls:
    return Controls.car(radius=0.47, turn=2 * math.pi / headings * times, **rest)


def both(grid, start, goal, controls, headings, max_count=10**9, footprint=CAR) -> Plan:
    """The plan, which is the oracle's."""
    tolerance = 0.153, 0.21
    field = grid.distance_field()
    args = footprint, start, goal, controls, tolerance, headings, max_count
    want = algorithm_10_2.plan(grid, field, *args)
    got = grid_dijkstra(grid, *args)
    assert (got.status, got.cost, got.expanded) == (want.status, want.cost, want.expanded)
    assert got.controls.tolist() == want.controls
    assert np.abs(got.poses - np.reshape(want.poses, (-1, 3))).max(initial=0.0) <= 1e-12
    return got


def corner(grid: OccupancyGrid, heading: float = 0.3) -> np.ndarray:
    return np.array([*np.asarray(grid.origin) + 0.617, heading])


def middle(grid: OccupancyGrid, heading: float = 1.1) -> np.ndarray:
    half = 0.1 * grid.occupied.shape[0] / 2
    return np.array([*np.asarray(grid.origin) + half + 0.033, heading])


def test_as_the_book_prints_it() -> None:
    """Same cost, path and count; reversals and directions have prices."""
    grid = cluttered(24, 1, 12)
    controls = car_like(16, costs=[11, 10, 11, 13, 12, 13], reversal=3)
    plan = both(grid, corner(grid), middle(grid), controls, 16)
    assert plan.found and plan.expanded > 150
    for count in (1, plan.expanded, plan.expanded + 1):
        again = both(grid, corner(grid), middle(grid), controls, 16, max_count=count)
        assert again.found == (count > plan.expanded)


def test_a_robot_that_turns_on_the_spot() -> None:
    grid = cluttered(20, 2, 3)
    spin = 2 * math.pi / 12 / 0.25
    controls = Controls(
        np.array([0.5, -0.5, 0, 0]), np.array([0, 0, spin, -spin]), 0.25, reversal=1
    )
    plan = both(grid, corner(grid), middle(grid, 0.9), controls, 12, footprint=Footprint.disc(0.17))
    assert plan.found


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_as_the_book_on_random_maps(seed: int) -> None:
    grid = cluttered(30, seed, 20 + 6 * seed)
    headings = (24, 36)[seed % 2]
    prices = ([1] * 6, [2, 2, 2, 3, 3, 3], [11, 10, 11, 13, 12, 13])[seed % 3]
    controls = car_like(headings, seed % 2 + 1, costs=prices, reversal=(0, 4)[seed // 4])
    plan = both(grid, corner(grid, 0.1 * seed), middle(grid, seed), controls, headings)
    assert plan.status in ("found", "no path")
    if plan.found:
        both(grid, corner(grid, 0.1 * seed), middle(grid, seed), controls, headings, plan.expanded)


@pytest.mark.slow
def test_as_the_book_on_a_large_map() -> None:
    grid = cluttered(200, 3, 260, 12)
    controls = car_like(72, 4, costs=[11, 10, 11, 13, 12, 13], reversal=3)
    plan = both(grid, corner(grid), corner(grid, 2.0) + np.array([5.1, 3.2, 0]), controls, 72)
    assert plan.expanded > 10_000


def swept(plan: Plan, controls: Controls, parts: int = 40) -> np.ndarray:
    """Poses on the way, by small steps of the midpoint rule."""
    out = [plan.poses[0]]
    for c in plan.controls:
        v, w, dt = controls.speeds[c], controls.turn_rates[c], controls.dt / parts
        for _ in range(parts):
            x, y, heading = out[-1]
            half = heading + w * dt / 2
            out.append(
                np.array(
                    [x + v * dt * math.cos(half), y + v * dt * math.sin(half), heading + w * dt]
                )
            )
    return np.array(out)


def test_a_plan_is_driven_and_free() -> None:
    """The controls lead along the poses to the goal, and no point of the car meets an obstacle."""
    grid = cluttered(60, 4, 25, 6)
    controls = car_like(36, 2, reversal=2)
    start, goal = corner(grid), middle(grid)
    plan = grid_dijkstra(grid, CAR, start, goal, controls, (0.15, 0.2), headings=36)
    assert plan.found and plan.poses.shape == (len(plan.controls) + 1, 3)
    way = swept(plan, controls)
    assert np.abs(way[::40] - plan.poses).max() < 1e-3
    assert np.hypot(*(plan.poses[-1] - goal)[:2]) <= 0.15
    assert abs(math.remainder(plan.poses[-1, 2] - goal[2], 2 * math.pi)) <= 0.2
    x, y = (
        a.ravel() for a in np.meshgrid(np.linspace(-0.13, 0.41, 19), np.linspace(-0.16, 0.16, 11))
    )
    c, s = np.cos(way[:, 2:]), np.sin(way[:, 2:])
    points = np.stack([way[:, :1] + c * x - s * y, way[:, 1:2] + s * x + c * y], -1)
    cell = np.asarray(grid.cell(jnp.asarray(points))).reshape(-1, 2)
    assert (cell >= 0).all() and not np.asarray(grid.occupied)[tuple(cell.T)].any()
    signs = np.sign(controls.speeds[plan.controls])
    assert plan.cost == len(signs) + 2 * (np.diff(signs) != 0).sum()
    driven = len(signs) * controls.dt
    assert driven >= float(reeds_shepp(start, plan.poses[-1], 0.47).length) - 1e-9


def test_named_results() -> None:
    grid = cluttered(24, 0, 0)
    walled = np.array(grid.occupied)
    walled[13] = True
    closed = OccupancyGrid(walled, grid.resolution, grid.origin)
    start, goal, controls = corner(grid), corner(grid) + np.array([1.1, 1.1, 0]), car_like(16)

    def status(grid, start, goal, **rest) -> tuple:
        plan = grid_dijkstra(grid, CAR, start, goal, controls, headings=16, **rest)
        assert (plan.cost is None) == (not plan.found)
        return plan.status, len(plan.poses), plan.expanded

    assert status(closed, start, goal)[:2] == ("no path", 0)
    assert status(closed, goal + np.array([-0.4, 0, 0]), start) == ("start in collision", 0, 0)
    assert status(grid, start - 9.0, goal) == ("start in collision", 0, 0)
    assert status(grid, start, goal + 9.0) == ("goal in collision", 0, 0)
    assert status(grid, start, goal, max_count=7) == ("count exhausted", 0, 7)
    assert status(grid, start, start + 0.05) == ("found", 1, 0)


def test_motion_tables() -> None:
    """Displacements against small steps; enlarged discs hold the footprint at every moment."""
    controls = Controls(np.array([0.6, 0.0, -0.4]), np.array([1.0, -2.0, 0.0]) * math.pi / 8, 1.0)
    table = MotionTable.of(controls, CAR, 0.2, 16, 0.1)
    assert table.turns.tolist() == [1, -2, 0]
    centers, radii = np.asarray(CAR.centers), np.asarray(CAR.radii)
    for k in (0, 5):
        heading = 0.2 + k * math.pi / 8
        for c in range(3):
            plan = Plan("found", 1, np.array([[0, 0, heading]]), np.array([c]))
            way = swept(plan, controls, 2000)
            assert np.abs(way[-1, :2] - table.step[:, k, c]).max() < 1e-6
            cos, sin = np.cos(way[:, 2:]), np.sin(way[:, 2:])
            x = way[:, :1] + cos * centers[:, 0] - sin * centers[:, 1]
            y = way[:, 1:2] + sin * centers[:, 0] + cos * centers[:, 1]
            to = np.hypot(x[..., None] - table.discs[0, k, c], y[..., None] - table.discs[1, k, c])
            assert ((to + radii[:, None] <= table.radii[k, c] + 1e-9).any(-1)).all()


GRID = OccupancyGrid(np.zeros((12, 12), bool), 0.1)
ROUND = Footprint.disc(0.1)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: Controls([1.0], [0.0, 1.0], 0.1), ["(1,), (2,) and (1,)", "(n,) each"]),
        (lambda: Controls([np.nan], [0.0], 0.1), ["speeds[0] is nan", "finite"]),
        (lambda: Controls([1.0], [0.0], 0.0), ["dt is 0.0", "above zero"]),
        (lambda: Controls([1.0], [0.0], 0.1, [1.5]), ["costs are [1.5]", "positive integers"]),
        (lambda: Controls([1.0], [0.0], 0.1, reversal=-1), ["reversal is -1"]),
        (lambda: Controls.car(radius=0.0, turn=0.1), ["radius is 0.0", "above zero"]),
        (
            lambda: grid_dijkstra(
                GRID, ROUND, [0.5] * 3, [0.6] * 3, Controls.car(radius=1.0, turn=0.3)
            ),
            ["turn_rates[0] * dt is 3.4", "72 heading cells", "an integer; change dt"],
        ),
        (
            lambda: grid_dijkstra(GRID, ROUND, [0.5] * 2, [0.6] * 3, car_like(72)),
            ["start is", "(3,)"],
        ),
        (
            lambda: grid_dijkstra(GRID, ROUND, [0.5] * 3, "there", car_like(72)),
            ["goal is 'there'", "(3,)"],
        ),
        (
            lambda: grid_dijkstra(GRID, ROUND, [0.5] * 3, [0.6] * 3, car_like(72), max_count=0),
            ["max_count is 0", "integer of at least 1"],
        ),
        (
            lambda: grid_dijkstra(GRID, ROUND, [0.5] * 3, [0.6] * 3, car_like(72), (0.1,)),
            ["tolerance is (0.1,)", "m and rad"],
        ),
        (
            lambda: grid_dijkstra(None, ROUND, [0.5] * 3, [0.6] * 3, car_like(72)),
            ["grid is None", "OccupancyGrid"],
        ),
    ],
    ids=range(12),
)
def test_wrong_arguments(call, words: list[str]) -> None:
    with pytest.raises(rb.InputError) as caught:
        call()
    for word in words:
        assert word in str(caught.value)
