"""A* on a grid of cells: `grid_dijkstra`, led by a lower bound of the way around obstacles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from rbjax.arguments import real_number
from rbjax.planning.maps.footprint import Footprint, clear
from rbjax.planning.maps.occupancy import OccupancyGrid
from rbjax.planning.paths.path import Plan
from rbjax.planning.search.best_first import Search
from rbjax.planning.search.controls import Controls, MotionTable
from rbjax.planning.search.ending import GoalSet
from rbjax.planning.search.grid_dijkstra import check_poses, check_problem


def grid_a_star(
    grid: OccupancyGrid,
    footprint: Footprint,
    start: Any,
    goal: Any,
    controls: Controls,
    tolerance: tuple[float, float] = (0.1, 0.1),
    headings: int = 72,
    max_count: int | None = None,
    weight: float = 1.0,
) -> Plan:
    """`grid_dijkstra` for one goal, with fewer cells.

    On a lattice, where all nodes of a cell coincide, the cost is the same. Elsewhere another node
    may stand for a cell, and the cost differs a little, either way.

    Args:
        weight: at least 1. The cost is at most so many times the least one; fewer cells are
            expanded for a greater weight.
        others: as `grid_dijkstra` takes them.

    Returns:
        `Plan`; `expanded` counts a cell as often as it is expanded.

    Raises:
        InputError: as `grid_dijkstra`; controls that cannot drive, a weight below 1.

    Source: Hart, Nilsson & Raphael, IEEE Trans. SSC 4 (1968) 100.

    Example:
        >>> walls = np.zeros((40, 40), bool)
        >>> walls[20, :25] = True
        >>> grid = OccupancyGrid(walls, 0.1)
        >>> car = Controls.car(radius=0.5, turn=np.deg2rad(20.0), reversal=2)
        >>> plan = grid_a_star(grid, Footprint.disc(0.2), [1, 1, 0], [3, 1, 0], car, headings=36)
        >>> plan.status, plan.poses.shape == (len(plan.controls) + 1, 3)
        ('found', True)
    """
    where = "grid_a_star"
    check_problem(where, grid, footprint, controls, tolerance, headings, max_count)
    start, goal = check_poses(where, start, goal)
    check_weight(where, weight)
    table = MotionTable.of(controls, footprint, start[2], headings, float(grid.resolution) / 2)
    distances = grid.distance_field()
    ends = np.stack([start, goal])
    free = np.asarray(clear(distances, ends, footprint))
    if not free.all():
        return Plan("goal in collision" if free[0] else "start in collision")
    ending = GoalSet(where, controls, tolerance)
    side = float(grid.resolution)
    plan, _ = Search(distances, footprint, controls, table, ends, side, weight, ending).run(
        max_count
    )
    if not plan.found:
        return plan
    assert plan.cost is not None
    return replace(plan, cost=int(plan.cost), path=controls.path(start, plan.controls))


def check_weight(where: str, weight: Any) -> None:
    """Refuse what is no weight of a search."""
    real_number(where, "weight", weight, least=1.0)
