"""A car among random boxes: 200 x 200 cells of 0.1 m, 72 headings, six controls with prices."""

from __future__ import annotations

import math

import numpy as np

from rbjax.planning import Controls, Footprint, OccupancyGrid

CELLS, HEADINGS, BOXES = 200, 72, 80
EACH = 9.0  # m along each axis, from the start to the goal
TOLERANCE = 0.15, 0.1
CONTROLS = Controls.car(
    0.47, 2 * math.pi / HEADINGS * 4, costs=[11, 10, 11, 13, 12, 13], reversal=3
)
CAR = Footprint.rectangle(ahead=0.41, behind=0.13, width=0.32, discs=3)


def clutter(seed: int) -> tuple[OccupancyGrid, np.ndarray]:
    """A map, and positions (n, 2) m on it that are 0.6 m from obstacles."""
    rng = np.random.default_rng(seed)
    cells = np.zeros((CELLS, CELLS), bool)
    for _ in range(BOXES):
        (i, j), (w, l) = rng.integers(0, CELLS, 2), rng.integers(1, 16, 2)
        cells[i : i + w, j : j + l] = True
    grid = OccupancyGrid(cells, 0.1, [-1.03, 0.57])
    inner = np.asarray(grid.distance_field().values)[1:-1, 1:-1]
    return grid, np.asarray(grid.center(np.argwhere(inner > 0.6))) + 0.017


def query(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Start and goal, apart by EACH."""
    start = places[np.argmin(places.sum(1))]
    goal = places[np.argmin(np.abs(places - start - EACH).sum(1))]
    return np.array([*start, 0.3]), np.array([*goal, 2.0])
