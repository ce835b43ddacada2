"""The planner and the heap of Algorithm 10.2, on a core: `python -m benchmarks.cpu.grid_dijkstra`.

A car among random boxes on a map of 200 x 200 cells of 0.1 m, 72 headings, six controls. The oracle
of the tests, plain NumPy and heapq, takes minutes; both must find the same path.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import math
import time

import numpy as np

from benchmarks.shared.timing import markdown_table, save
from rbjax.planning import Controls, Footprint, OccupancyGrid, grid_dijkstra
from tests.planning import algorithm_10_2

CELLS, HEADINGS, BOXES = 200, 72, 80
EACH = 9.0  # m along each axis, from the start to the goal


def problem(seed: int) -> tuple:
    """(grid, footprint, start, goal, controls, tolerance, headings, max_count)"""
    rng = np.random.default_rng(seed)
    cells = np.zeros((CELLS, CELLS), bool)
    for _ in range(BOXES):
        (i, j), (w, l) = rng.integers(0, CELLS, 2), rng.integers(1, 16, 2)
        cells[i : i + w, j : j + l] = True
    grid = OccupancyGrid(cells, 0.1, [-1.03, 0.57])
    inner = np.asarray(grid.distance_field().values)[1:-1, 1:-1]
    places = np.asarray(grid.center(np.argwhere(inner > 0.6))) + 0.017
    start = places[np.argmin(places.sum(1))]
    goal = places[np.argmin(np.abs(places - start - EACH).sum(1))]
    controls = Controls.car(
        0.47, 2 * math.pi / HEADINGS * 4, costs=[11, 10, 11, 13, 12, 13], reversal=3
    )
    car = Footprint.rectangle(ahead=0.41, behind=0.13, width=0.32, discs=3)
    return (
        grid, car, np.array([*start, 0.3]), np.array([*goal, 2.0]), controls, (0.15, 0.1),
        HEADINGS, 10**9,
    )  # fmt: skip


def timed(f, *args) -> tuple:
    start = time.perf_counter()
    return f(*args), time.perf_counter() - start


def main() -> None:
    rows = []
    for seed in range(3):
        args = problem(seed)
        grid_dijkstra(*args)
        plan, seconds = min((timed(grid_dijkstra, *args) for _ in range(5)), key=lambda x: x[1])
        field = args[0].distance_field()
        want, book = timed(algorithm_10_2.plan, args[0], field, *args[1:])
        assert (plan.status, plan.cost, plan.expanded) == (want.status, want.cost, want.expanded)
        assert plan.controls.tolist() == want.controls
        rows.append(
            {
                "seed": seed, "status": plan.status, "cost": plan.cost, "expanded": plan.expanded,
                "rbjax s": seconds, "heap s": book, "ratio": book / seconds,
            }
        )  # fmt: skip
        print(markdown_table(rows[-1:], rows[0]), flush=True)
    print(markdown_table(rows, rows[0]))
    print(save("cpu-grid-dijkstra", rows))


if __name__ == "__main__":
    main()
