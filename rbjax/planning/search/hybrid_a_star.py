"""Hybrid A*: continuous poses in cells, led by lower bounds, ended by an exact curve.

Controls lead from cell to cell (`best_first`). From the nodes of least f, the direct connection
with the target, Reeds and Shepp's curve for a car, is tested for obstacles. If it is free, it ends
a path exactly where it should. Its length is also one of the two lower bounds.

Cramped ends. A direct connection needs room, so it should end where there is some: the root is the
end with less clearance. From the goal, controls are driven backwards in time.

Source: Dolgov, Thrun, Montemerlo & Diebel, *Path planning for autonomous vehicles in unknown
semi-structured environments*, Int. J. Robotics Research 29 (2010) 485.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_number
from rbjax.errors import InputError
from rbjax.planning.maps.footprint import Footprint, clear, clearance
from rbjax.planning.maps.occupancy import OccupancyGrid
from rbjax.planning.paths.path import Path, Plan
from rbjax.planning.search.best_first import MOST_CELLS, Search
from rbjax.planning.search.controls import Controls, MotionTable
from rbjax.planning.search.ending import Direct
from rbjax.planning.search.grid_a_star import check_weight
from rbjax.planning.search.grid_dijkstra import check_poses, check_problem


def hybrid_a_star(
    grid: OccupancyGrid,
    footprint: Footprint,
    start: Any,
    goal: Any,
    controls: Controls,
    headings: int = 72,
    cell: float | None = None,
    weight: float = 1.0,
    max_count: int | None = None,
    root: str | None = None,
) -> Plan:
    """A cheap path of controls and of one direct connection, from a pose exactly to another.

    Args:
        grid: the map; what is beyond it counts as occupied.
        footprint: what the robot covers.
        start, goal: poses (3,): x and y in m, the heading in rad.
        controls: each turns by a multiple of 2 pi / headings, and leaves a cell in its dt. To the
            left and to the right, the smallest turning radius is the same.
        headings: the number of cells of a turn.
        cell: the side of a cell in m; None for the map's resolution.
        weight: at least 1. The price is at most so many times the least one; fewer cells are
            expanded for a greater weight.
        max_count: expand at most so many nodes; None for no limit. If it is exhausted, the best
            path until then is the result, if there is one.
        root: "start" or "goal", the end from which the search grows; None for the one with less
            clearance.

    Returns:
        `Plan`. Its `path` ends at the goal, to rounding. A map without a path is a status, not an
        error.

    Raises:
        InputError: wrong types or shapes, values that are not finite, controls whose turns are no
            multiples of a heading's cell, that cannot turn, or whose radii differ.

    Source: Dolgov, Thrun, Montemerlo & Diebel, Int. J. Robotics Research 29 (2010) 485.

    Example:
        >>> walls = np.zeros((40, 40), bool)
        >>> walls[20, :25] = True
        >>> grid = OccupancyGrid(walls, 0.1)
        >>> car = Controls.car(radius=0.5, turn=np.deg2rad(20.0), reversal=2)
        >>> plan = hybrid_a_star(grid, Footprint.disc(0.2), [1, 1, 0], [3, 1, 0], car, headings=36)
        >>> plan.status, plan.poses[-1].tolist()
        ('found', [3.0, 1.0, 0.0])
    """
    where = "hybrid_a_star"
    check_problem(where, grid, footprint, controls, (0.0, 0.0), headings, max_count)
    start, goal = check_poses(where, start, goal)
    cell = float(grid.resolution) if cell is None else cell
    real_number(where, "cell", cell, "a length above zero, or None", above=0.0, traced=True)
    cells = np.prod(np.ceil(np.array(grid.occupied.shape) * float(grid.resolution) / cell))
    if cells * headings > MOST_CELLS:
        raise InputError(
            f"{where}: cell is {cell}, which makes {cells * headings:.1e} cells with their "
            f"headings, expected at most {MOST_CELLS:.0e}; take a larger cell, or None"
        )
    check_weight(where, weight)
    if root not in (None, "start", "goal"):
        raise InputError(f"{where}: root is {root!r}, expected 'start', 'goal' or None")
    distances = grid.distance_field()
    ends = np.stack([start, goal])
    free = np.asarray(clear(distances, ends, footprint))
    if not free.all():
        return Plan("goal in collision" if free[0] else "start in collision")
    if root is None:
        room = np.asarray(clearance(distances, ends, footprint))
        root = "goal" if room[1] < room[0] else "start"
    if root == "goal":
        ends, back = ends[::-1], controls.in_reverse()
    else:
        back = controls
    table = MotionTable.of(back, footprint, ends[0, 2], headings, float(grid.resolution) / 2)
    search = Search(distances, footprint, back, table, ends, cell, weight, Direct(where, back))
    plan, steps = search.run(max_count)
    if not plan.found:
        return plan
    return _between(plan, steps, start, goal, root == "goal")


def _between(
    plan: Plan, steps: np.ndarray, start: np.ndarray, goal: np.ndarray, reverse: bool
) -> Plan:
    """A plan from the root as one from the start; ends that are exact."""
    poses, controls = plan.poses, plan.controls
    if reverse:
        poses, controls, steps = poses[::-1].copy(), controls[::-1].copy(), -steps[::-1]
        poses[:, 2] += start[2] - poses[0, 2]
    poses[0] = start
    poses[-1] = *goal[:2], goal[2] + 2 * math.pi * round((poses[-1, 2] - goal[2]) / (2 * math.pi))
    path = Path(jnp.asarray(start), jnp.asarray(steps))
    return replace(plan, poses=poses, controls=controls, path=path)
