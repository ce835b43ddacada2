"""Grid-based Dijkstra for a wheeled robot: Algorithm 10.2 of *Modern Robotics*, wave by wave.

    OPEN <- {start}
    while OPEN is not empty and fewer than max_count cells are visited:
        current <- the first node of OPEN, by cost and then by age
        if current is in the goal set: found
        if the cell of current is not visited yet:
            visit it
            for each control: integrate it for dt; if the motion is free, put its end into OPEN

A cell is (x, y, heading). A node keeps the integrated configuration, not its cell's centre, so a
path is exactly the motion of its controls. Cells only prune the search: the first node popped in a
cell represents it, and later ones are dropped. Therefore the cost is the least among the paths of
nodes that are kept, not among all sequences of controls. With a cost of reversals, the node of a
cell also determines the direction of arrival. Of two nodes of equal cost the older one is first.

Costs of controls are positive integers, so the children of nodes of one cost have larger costs, and
all nodes of OPEN of one cost form a wave. In a wave, the oldest node of a cell that is not visited
represents it. Children are appended in the order of parents and of controls, which is the order of
their ages. So the result is exactly the same as with a heap, and a wave is a few array operations.

A node is dropped before its motion is tested if its cell is visited, or has a free node of the same
or lower cost in OPEN, unless it is in the goal set. Motions far from obstacles need no test.

If all motions end at the centres of cells (a state lattice), all nodes of a cell coincide, and this
is Dijkstra's algorithm on the lattice.

Source: Lynch & Park, *Modern Robotics*, 10.4.2; Dial, Comm. ACM 12 (1969) 632, for the waves.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbjax.planning.maps.footprint import Footprint
from rbjax.planning.maps.occupancy import OccupancyGrid
from rbjax.planning.paths.path import Plan
from rbjax.planning.search.controls import Controls, MotionTable
from rbjax.planning.search.wave_search import (
    Shelves,
    WaveSearch,
    add_to,
    check_poses,
    check_problem,
    collision,
    join,
    take,
)

NEVER, VISITED = np.iinfo(np.int64).max, -1


def grid_dijkstra(
    grid: OccupancyGrid,
    footprint: Footprint,
    start: Any,
    goal: Any,
    controls: Controls,
    tolerance: tuple[float, float] = (0.1, 0.1),
    headings: int = 72,
    max_count: int | None = None,
) -> Plan:
    """Search the cheapest sequence of controls that moves a robot to a goal, on a grid of cells.

    Args:
        grid: the map. Cells beyond it count as occupied.
        footprint: the area that the robot covers.
        start, goal: poses (3,): x and y in m, the heading in rad.
        controls: the turn of each is a multiple of 2 pi / headings, and each motion of length dt is
            longer than a cell.
        tolerance: of the goal set: distance from the goal in m, angle from its heading in rad.
        headings: the number of cells of a full turn.
        max_count: the largest number of cells to visit; None for no limit.

    Returns:
        `Plan`. If there is no path, `status` has the reason; that is not an error.

    Raises:
        InputError: wrong types or shapes, values that are not finite, controls whose turns are not
            multiples of a heading's cell.

    Source: Lynch & Park, *Modern Robotics*, Algorithm 10.2.

    Example:
        >>> walls = np.zeros((40, 40), bool)
        >>> walls[20, :25] = True
        >>> grid = OccupancyGrid(walls, 0.1)
        >>> car = Controls.car(radius=0.5, turn=np.deg2rad(20.0), reversal=2)
        >>> plan = grid_dijkstra(grid, Footprint.disc(0.2), [1, 1, 0], [3, 1, 0], car, headings=36)
        >>> plan.status, plan.cost, len(plan.controls)
        ('found', 28, 28)
    """
    where = "grid_dijkstra"
    check_problem(where, grid, footprint, controls, tolerance, headings, max_count)
    start, goal = check_poses(where, start, goal)
    distances = grid.distance_field()
    blocked = collision(distances, footprint, start, goal)
    if blocked is not None:
        return blocked
    table = MotionTable.of(controls, footprint, start[2], headings, float(grid.resolution) / 2)
    search = _Dijkstra(distances, controls, table, start, float(grid.resolution), np.int64(NEVER))
    return search.run(goal, tolerance, NEVER if max_count is None else max_count)


class _Nodes(NamedTuple):
    """Nodes of the search, ordered by age (`wave_search`)."""

    x: np.ndarray
    y: np.ndarray
    cell: np.ndarray
    parent: np.ndarray
    control: np.ndarray
    age: np.ndarray  # counter of created nodes


NONE = _Nodes(np.zeros(0), np.zeros(0), *np.zeros((4, 0), np.intp))


class _Dijkstra(WaveSearch):
    """Dijkstra search that stores the nodes of OPEN, and the nodes in the goal set, by cost."""

    def run(self, goal: np.ndarray, tolerance: tuple[float, float], max_count: int) -> Plan:
        """Search the cheapest path to the goal set. Return the plan."""
        turn = np.abs(np.remainder(self.table.headings - goal[2] + math.pi, 2 * math.pi) - math.pi)
        self.goal, self.near, self.towards = goal, tolerance[0], turn <= tolerance[1]
        self.reached: Shelves = {}
        self.age = 1
        zero = np.zeros(1, np.intp)
        x, y = self.root[:1], self.root[1:2]
        cell, inside = self.cells(x, y, zero)
        if not inside[0]:
            return Plan("start in collision")
        first = _Nodes(x, y, cell, zero - 1, zero - 1, zero)
        self.best[cell] = 0
        self.open[0] = [first]
        if self.is_goal(x, y, zero)[0]:
            self.reached[0] = [first]
        while self.open or self.reached:
            cost = min([*self.open, *self.reached])
            wave = join(self.open.pop(cost, [NONE]))
            wave = take(wave, self.best[wave.cell] == cost)  # nodes that represent their cells
            if cost in self.reached:
                last = join(self.reached[cost])
                oldest = int(last.age.argmin())
                last = take(last, slice(oldest, oldest + 1))
                before = self.count + int((wave.age < last.age).sum())
                if before < max_count:
                    poses, chosen = self.way_to(last)
                    path = self.controls.path(self.root, chosen)
                    return Plan("found", cost, poses, chosen, before, path)
            if cost in self.reached or self.count + len(wave.age) > max_count:
                return Plan("count exhausted", expanded=max_count)
            self.expand(wave, cost)
        return Plan("no path", expanded=self.count)

    def expand(self, wave: _Nodes, cost: int) -> None:
        """Mark the nodes of a wave as visited, and put their children into OPEN."""
        self.best[wave.cell] = VISITED
        self.visited.append(wave)
        n = len(self.table.turns)
        x, y, heading = self.children(wave)
        cell, inside = self.cells(x, y, heading)
        new = _Nodes(
            x.ravel(), y.ravel(), cell.ravel(),
            np.repeat(self.count + np.arange(len(wave.x)), n), np.tile(np.arange(n), len(wave.x)),
            self.age + np.arange(x.size),
        )  # fmt: skip
        self.age += x.size
        goal = self.is_goal(x, y, heading).ravel()
        costs = (cost + self.prices[wave.control]).ravel()
        wanted = np.flatnonzero(inside.ravel() & (goal | (self.best[new.cell] > costs)))
        wanted = wanted[np.argsort(costs[wanted], kind="stable")]  # by cost, and then by age
        new, goal, costs = take(new, wanted), goal[wanted], costs[wanted]
        better = self.best[new.cell] > costs
        free, kept = self.admit(wave, new, costs, better, goal | self.first_of(new.cell))
        for shelves, some in ((self.open, kept), (self.reached, np.flatnonzero(free & goal))):
            add_to(shelves, costs[some], take(new, some))
        self.count += len(wave.x)

    def is_goal(self, x: np.ndarray, y: np.ndarray, k: np.ndarray) -> np.ndarray:
        """Return, for each node, whether it is in the goal set."""
        near = np.hypot(x - self.goal[0], y - self.goal[1]) <= self.near
        return near & self.towards[k]
