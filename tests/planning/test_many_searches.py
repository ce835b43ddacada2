"""Many searches at once against one search after the other."""

import numpy as np
import pytest

import rbjax as rb
from rbjax.planning import Footprint, OccupancyGrid, grid_dijkstra, grid_dijkstra_many
from tests.planning.test_grid_dijkstra import CAR, car_like, cluttered

NEAR = 0.153, 0.21


def queries(grid: OccupancyGrid, n: int, seed: int) -> np.ndarray:
    """Starts and goals (2, n, 3), most of them free."""
    rng = np.random.default_rng(seed)
    values = np.asarray(grid.distance_field().values)[1:-1, 1:-1]
    places = np.asarray(grid.center(np.argwhere(values > 0.3)))
    xy = places[rng.integers(0, len(places), (2, n))] + rng.uniform(-0.05, 0.05, (2, n, 2))
    return np.concatenate([xy, rng.uniform(-3, 3, (2, n, 1))], -1)


@pytest.mark.slow
def test_as_one_after_the_other() -> None:
    """Cost, path and count of each; many statuses; with a limit on the count, and without."""
    grid = cluttered(40, 1, 26)
    starts, goals = queries(grid, 24, 0)
    controls = car_like(36, 2, costs=[11, 10, 11, 13, 12, 13], reversal=3)
    seen = set()
    for count in (None, 300):
        args = controls, NEAR, 36, count
        many = grid_dijkstra_many(grid, CAR, starts, goals, *args)
        for plan, start, goal in zip(many, starts, goals, strict=True):
            want = grid_dijkstra(grid, CAR, start, goal, *args)
            got = plan.status, plan.cost, plan.expanded, plan.controls.tolist()
            assert got == (want.status, want.cost, want.expanded, want.controls.tolist())
            assert np.abs(plan.poses - want.poses).max(initial=0.0) <= 1e-12
            seen.add(plan.status)
    assert seen >= {"found", "start in collision", "goal in collision", "count exhausted"}


@pytest.mark.slow
def test_room_and_precision() -> None:
    """A list that is full is a status; f32 finds paths of about the same cost."""
    grid = cluttered(30, 3, 8)
    starts, goals = queries(grid, 6, 5)
    args = car_like(24), NEAR, 24
    plans = grid_dijkstra_many(grid, CAR, starts, goals, *args)
    assert sum(plan.found for plan in plans) >= 3
    short = grid_dijkstra_many(grid, CAR, starts, goals, *args, nodes=40)
    tried = [a.status for a, b in zip(short, plans, strict=True) if b.expanded > 40]
    assert tried and set(tried) == {"count exhausted"}
    single = OccupancyGrid(grid.occupied, np.float32(0.1), np.asarray(grid.origin, np.float32))
    rough = grid_dijkstra_many(single, CAR, starts, goals, *args)
    assert rough[0].poses.dtype == np.float64  # the plan is the host's
    assert all(
        abs(a.cost - b.cost) <= 2 for a, b in zip(rough, plans, strict=True) if a.found and b.found
    )


def test_wrong_arguments() -> None:
    grid = OccupancyGrid(np.zeros((12, 12), bool), 0.1)
    for starts, goals, words in (
        ([0.5] * 3, [[0.5] * 3], ["grid_dijkstra_many: starts is", "(q, 3)"]),
        ([[0.5] * 3], [[0.5] * 3] * 2, ["1 starts and 2 goals"]),
    ):
        with pytest.raises(rb.InputError) as caught:
            grid_dijkstra_many(grid, Footprint.disc(0.1), starts, goals, car_like(72))
        for word in words:
            assert word in str(caught.value)
