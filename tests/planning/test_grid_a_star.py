"""A* against Dijkstra's algorithm; its bound of the way around obstacles against a search."""

import math

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

import rbjax as rb
from rbjax.planning import Controls, Footprint, OccupancyGrid, grid_a_star, grid_dijkstra
from rbjax.planning.search.holonomic import KAPPA, HolonomicDistance
from tests.planning.scenes import H, room
from tests.planning.test_grid_dijkstra import CAR, car_like, cluttered, corner, middle

#: a quarter turn on the spot, or one cell ahead or back: motions end at cells' centres
LATTICE = Controls(
    [H, -H, 0, 0], [0, 0, math.pi / 2, -math.pi / 2], 1.0, costs=[2, 3, 1, 1], steering=0
)


def on_a_lattice(seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells = rng.random((24, 20)) < 0.3
    cells[0, 0] = cells[-1, -1] = False
    grid = OccupancyGrid(cells, H)
    start, goal = [0.05, 0.05, 0.0], [2.35, 1.95, math.pi / 2]
    args = grid, Footprint.disc(0.02), start, goal, LATTICE, (1e-6, 1e-6), 4
    want, got = grid_dijkstra(*args), grid_a_star(*args)
    assert (got.status, got.cost) == (want.status, want.cost)
    if want.found:
        assert got.expanded < want.expanded
        assert sum(LATTICE.costs[got.controls]) == got.cost


@pytest.mark.parametrize("seeds", [range(12), pytest.param(range(12, 50), marks=pytest.mark.slow)])
def test_the_cost_of_dijkstra_on_a_lattice(seeds: range) -> None:
    for seed in seeds:
        on_a_lattice(seed)


def test_fewer_cells_at_about_the_cost() -> None:
    """In cells with continuous poses another node may stand for a cell."""
    visits = []
    for seed in range(3):
        grid = cluttered(60, seed, 25, 6)
        controls = car_like(36, 2, costs=[11, 10, 11, 13, 12, 13], reversal=3, steering=1)
        args = grid, CAR, corner(grid), middle(grid), controls, (0.15, 0.2), 36
        want, got, quick = grid_dijkstra(*args), grid_a_star(*args), grid_a_star(*args, weight=1.5)
        assert got.found and abs(got.cost - want.cost) <= 0.05 * want.cost
        assert got.cost == controls.prices[[-1, *got.controls[:-1]], got.controls].sum()
        assert quick.cost <= 1.5 * got.cost + 1
        visits.append((want.expanded, got.expanded))
    assert 2 * sum(v[1] for v in visits) < sum(v[0] for v in visits)


def lattice_way(grid: OccupancyGrid, shape: Footprint, goal, finer: int) -> tuple:
    """Shortest chains of moves between free points of a finer lattice: at least the true way."""
    n = np.array(grid.occupied.shape) * finer
    step = H / finer
    points = (np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), -1) + 0.5) * step
    poses = np.concatenate([points, np.zeros((*n, 1))], -1)
    free = np.asarray(rb.planning.clear(grid.distance_field(), poses, shape))
    number = np.arange(free.size).reshape(free.shape)
    edges = []
    for i, j in ((1, 0), (0, 1), (1, 1), (1, -1), (2, 1), (1, 2), (2, -1), (1, -2)):
        a = number[: n[0] - i, max(0, -j) : n[1] - max(0, j)]
        b = number[i:, max(0, j) : n[1] - max(0, -j)]
        both = free.ravel()[a] & free.ravel()[b]
        edges.append((a[both], b[both], np.full(both.sum(), step * math.hypot(i, j))))
    a, b, way = (np.concatenate(x) for x in zip(*edges, strict=True))
    graph = sparse.csr_array((way, (a, b)), (free.size, free.size))
    at = np.argmin(np.where(free, np.hypot(*(points - goal).transpose(2, 0, 1)), np.inf))
    return points.reshape(-1, 2), dijkstra(graph, directed=False, indices=at), at


@pytest.mark.parametrize("seed", range(3))
def test_the_way_around_is_a_lower_bound(seed: int) -> None:
    """Never more than the way that an exhaustive search finds on a finer lattice.

    Moves of the finer lattice jump over at most one of its points, two fifths of a cell.
    """
    rng = np.random.default_rng(seed)
    boxes = [(x, y, x + 0.3 + w, y + 0.3) for x, y, w in rng.uniform(0, [3.5, 3.5, 0.6], (6, 3))]
    grid, shape = room(4, 4, *boxes), Footprint.disc(0.12)
    points, way, at = lattice_way(grid, shape, np.array([0.4, 3.7]), 5)
    bound = HolonomicDistance(grid.distance_field(), shape, points[at])(*points.T)
    reached = np.isfinite(way)
    assert reached.sum() > 1000
    assert (bound[reached] <= way[reached] + 1e-9).all()
    # no less than the straight way, but for the moves' and the corners' share; more behind boxes
    straight = np.hypot(*(points - points[at]).T)
    assert (bound >= straight / KAPPA - 3 * H)[reached].all()
    assert (bound > straight)[reached].any()


def test_named_results() -> None:
    grid, shape = room(4, 3, (2, 0, 2.3, 3)), Footprint.disc(0.2)
    steer = Controls.car(0.5, math.radians(15))

    def status(start, goal, **rest) -> tuple:
        plan = grid_a_star(grid, shape, start, goal, steer, **rest)
        return plan.status, plan.expanded, len(plan.poses)

    assert status((1, 1, 0), (3, 1, 0)) == ("no path", 0, 0)
    assert status((2.1, 1, 0), (3, 1, 0)) == ("start in collision", 0, 0)
    assert status((1, 1, 0), (2.1, 1, 0)) == ("goal in collision", 0, 0)
    assert status((0.5, 0.5, 0), (1.5, 2.5, 0), max_count=10) == ("count exhausted", 10, 0)
    assert status((0.5, 0.5, 0), (0.55, 0.5, 0)) == ("found", 1, 1)
    with pytest.raises(rb.InputError, match="weight is 0"):
        status((1, 1, 0), (1, 1, 0), weight=0)
    with pytest.raises(rb.InputError, match="cannot drive"):
        grid_a_star(grid, shape, [1] * 3, [1] * 3, Controls([0.0], [math.pi / 36], 1.0))
