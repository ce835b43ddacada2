"""A* search by waves: many nodes of least f are expanded at once.

    OPEN <- {root};  f(node) = g(node) + weight * h(node)
    while a node of OPEN has f less than the price of the best path:
        for the nodes of least f: connect them with the target, if possible, which gives a path.
            Then for each control: integrate it for dt. If the motion is free, and the cell of its
            end has no node with g as low, put its end into OPEN

g is the price of the path to a node, as `Controls` counts it. h is the larger of two lower bounds
of the price to the target: of the connection without obstacles (`connections`), and of the shortest
path of a point around obstacles (`holonomic`). So the result costs at most `weight` times the least
price among the paths of nodes that are kept. A cell keeps one node at a time. A cheaper node
replaces it and is expanded again, so nodes can be expanded in any order.

Connections are computed only for nodes of least f. If the bound of a connection exceeds the other
bound, the node returns to OPEN with its new f. Hybrid A* connects by a motion that ends exactly at
the target; for a car this is the Reeds-Shepp curve. It needs free space, so the root of the search
is the end with less clearance. From the goal, controls are driven backwards in time.

Source: Hart, Nilsson & Raphael, IEEE Trans. SSC 4 (1968) 100; Pohl, Artificial Intelligence 1
(1970) 193, for the weight; Dolgov, Thrun, Montemerlo & Diebel, *Path planning for autonomous
vehicles in unknown semi-structured environments*, Int. J. Robotics Research 29 (2010) 485.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_number
from rbjax.errors import InputError
from rbjax.planning.maps.footprint import Footprint, clearance
from rbjax.planning.maps.occupancy import DistanceField, OccupancyGrid
from rbjax.planning.paths.path import Path, Plan, chain
from rbjax.planning.search.connections import DirectMotion, GoalSet
from rbjax.planning.search.controls import Controls, MotionTable
from rbjax.planning.search.holonomic import HolonomicDistance
from rbjax.planning.search.wave_search import (
    WaveSearch,
    add_to,
    check_poses,
    check_problem,
    collision,
    join,
    take,
)

#: the largest number of cells of a search: 4 GB of costs and indices
MOST_CELLS = 500_000_000
NEVER = np.iinfo(np.int32).max
SMALLEST_WAVE = 64  # intervals of f are added to a wave until it has this many nodes
TESTED = 32  # the number of cheapest connections that are tested for obstacles in a wave


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
    """Search for a low-cost path that ends exactly at the goal pose, by hybrid A*.

    The path is a sequence of controls, followed by one direct motion to the goal.

    Args:
        grid: the map. Cells beyond it count as occupied.
        footprint: the area that the robot covers.
        start, goal: poses (3,): x and y in m, the heading in rad.
        controls: the turn of each is a multiple of 2 pi / headings, and each motion of length dt is
            longer than a cell. The smallest turning radius must be the same to the left and to the
            right.
        headings: the number of cells of a full turn.
        cell: the side of a cell, m; None for the map's resolution.
        weight: at least 1. The cost is at most `weight` times the least cost. A larger weight
            expands fewer cells.
        max_count: the largest number of nodes to expand; None for no limit. If it is exhausted, the
            result is the best path so far, if there is one.
        root: "start" or "goal", the end from which the search grows; None for the end with less
            clearance.

    Returns:
        `Plan`. Its `path` ends at the goal, up to rounding. If there is no path, `status` has the
        reason; that is not an error.

    Raises:
        InputError: wrong types or shapes, values that are not finite; controls whose turns are not
            multiples of a heading's cell, that cannot turn, or whose turning radii differ.

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
    real_number(where, "cell", cell, "a length above zero, or None", above=0.0)
    real_number(where, "weight", weight, least=1.0)
    _check_cells(where, grid, cell, headings)
    if root not in (None, "start", "goal"):
        raise InputError(f"{where}: root is {root!r}, expected 'start', 'goal' or None")
    distances = grid.distance_field()
    blocked = collision(distances, footprint, start, goal)
    if blocked is not None:
        return blocked
    ends = np.stack([start, goal])
    if root is None:
        room = np.asarray(clearance(distances, jnp.asarray(ends), footprint))
        root = "goal" if room[1] < room[0] else "start"
    reverse = root == "goal"
    if reverse:
        ends, controls = ends[::-1], controls.in_reverse()
    search = _AStar(
        distances, footprint, controls, ends, headings, cell, weight, DirectMotion(where, controls)
    )
    plan, steps = search.run(max_count)
    if not plan.found:
        return plan
    poses, chosen = plan.poses, plan.controls
    if reverse:  # from the start, with exact ends
        poses, chosen, steps = poses[::-1].copy(), chosen[::-1].copy(), -steps[::-1]
        poses[:, 2] += start[2] - poses[0, 2]
    poses[0] = start
    poses[-1] = *goal[:2], goal[2] + 2 * math.pi * round((poses[-1, 2] - goal[2]) / (2 * math.pi))
    path = Path(jnp.asarray(start), jnp.asarray(steps))
    return replace(plan, poses=poses, controls=chosen, path=path)


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
    """Search for a low-cost sequence of controls to a goal, which visits fewer cells than
    `grid_dijkstra`.

    On a lattice, where all nodes of a cell coincide, the cost is the same as by `grid_dijkstra`.
    Otherwise another node may represent a cell, and the cost may be slightly lower or higher.

    Args:
        grid, footprint, start, goal, controls, tolerance, headings, max_count: as for
            `grid_dijkstra`.
        weight: at least 1. The cost is at most `weight` times the least cost. A larger weight
            expands fewer cells.

    Returns:
        `Plan`. `expanded` counts a cell each time that it is expanded.

    Raises:
        InputError: as for `grid_dijkstra`; controls that cannot drive, a weight below 1.

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
    real_number(where, "weight", weight, least=1.0)
    side = float(grid.resolution)
    _check_cells(where, grid, side, headings)
    distances = grid.distance_field()
    blocked = collision(distances, footprint, start, goal)
    if blocked is not None:
        return blocked
    ending = GoalSet(where, controls, tolerance)
    ends = np.stack([start, goal])
    search = _AStar(distances, footprint, controls, ends, headings, side, weight, ending)
    plan, _ = search.run(max_count)
    if not plan.found:
        return plan
    assert plan.cost is not None
    return replace(plan, cost=int(plan.cost), path=controls.path(start, plan.controls))


def _check_cells(where: str, grid: OccupancyGrid, cell: float, headings: int) -> None:
    """Raise `InputError` if the search would have more cells than `MOST_CELLS`."""
    cells = np.prod(np.ceil(np.array(grid.occupied.shape) * float(grid.resolution) / cell))
    if cells * headings > MOST_CELLS:
        raise InputError(
            f"{where}: cell is {cell}, which makes {cells * headings:.1e} cells with their "
            f"headings, expected at most {MOST_CELLS:.0e}; take a larger cell, or None"
        )


class _Nodes(NamedTuple):
    """Nodes of the search, one row each (`wave_search`)."""

    x: np.ndarray
    y: np.ndarray
    cell: np.ndarray
    parent: np.ndarray
    control: np.ndarray
    g: np.ndarray  # price of the path to the node
    known: np.ndarray  # whether f includes the lower bound of the connection


class _AStar(WaveSearch):
    """A* search. OPEN is sorted by intervals of the priority value f = cost + lower bound."""

    def __init__(
        self, distances: DistanceField, footprint: Footprint, controls: Controls, ends: np.ndarray,
        headings: int, side: float, weight: float, ending: DirectMotion | GoalSet,
    ):  # fmt: skip
        """Prepare a search.

        ends: (2, 3), the poses of the root and of the target.
        side: the side of a cell, m. weight: factor of the lower bound in the priority f of a node.
        ending: the condition or last motion that ends the search.
        """
        spacing = float(distances.resolution) / 2
        table = MotionTable.of(controls, footprint, ends[0, 2], headings, spacing)
        super().__init__(distances, controls, table, ends[0], side, np.int32(NEVER))
        self.footprint, self.target, self.ending, self.weight = footprint, ends[1], ending, weight
        self.holonomic = HolonomicDistance(distances, footprint, self.target)
        self.width = float(controls.costs.min())  # of an interval of f
        self.price = math.inf  # of the best path
        self.end: tuple[_Nodes, np.ndarray] | None = None  # its last node, and its connection
        self.untested: list[tuple[_Nodes, np.ndarray, np.ndarray]] = []

    def run(self, max_count: int | None) -> tuple[Plan, np.ndarray]:
        """Search a path. Return the plan from the root to the target, and its steps (n, 3)."""
        limit = 2**63 - 1 if max_count is None else max_count
        zero = np.zeros(1, np.intp)
        x, y = self.root[:1], self.root[1:2]
        cell, _ = self.cells(x, y, zero)
        self.best[cell] = 0
        far = self.around(x, y)
        if not np.isfinite(far).all():
            return Plan("no path"), np.zeros((0, 3))
        self.put(_Nodes(x, y, cell, zero - 1, zero - 1, zero, np.zeros(1, bool)), self.weight * far)
        exhausted = False
        while self.open and not exhausted:
            if min(self.open) * self.width >= self.price:
                break
            nodes = self.connected(*self.cheapest())
            exhausted = self.count + len(nodes.x) > limit
            self.expand(take(nodes, slice(limit - self.count)))
        for nodes, steps, price in self.untested:
            self.test(nodes, steps, price, len(price))
        if self.end is None:
            status = "count exhausted" if exhausted else "no path"
            return Plan(status, expanded=self.count), np.zeros((0, 3))
        return self.plan(*self.end)

    def around(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Compute a lower bound of the cost to the target: the shortest path around obstacles."""
        return self.ending.rate * np.maximum(self.holonomic(x, y) - self.ending.near, 0.0)

    def put(self, nodes: _Nodes, f: np.ndarray) -> None:
        """Insert nodes with the priority values f into OPEN."""
        add_to(self.open, (f / self.width).astype(int), nodes)

    def cheapest(self) -> tuple[_Nodes, int]:
        """Remove and return the nodes of lowest priority value f that represent their cells.

        Also return the last interval of f that they are in.
        """
        some: list[_Nodes] = []
        number = 0
        for interval in sorted(self.open):
            if number >= SMALLEST_WAVE or interval * self.width >= self.price:
                break
            nodes = join(self.open.pop(interval))
            some.append(take(nodes, self.best[nodes.cell] == nodes.g))
            number += len(some[-1].x)
            last = interval
        return join(some), last

    def poses(self, nodes: _Nodes) -> np.ndarray:
        """Return the poses (n, 3) of nodes."""
        return np.column_stack([nodes.x, nodes.y, self.table.headings[nodes.cell % self.shape[2]]])

    def connected(self, nodes: _Nodes, interval: int) -> _Nodes:
        """Connect nodes with the target. Return the nodes whose f stays within the interval. Nodes
        whose new f is beyond the interval return to OPEN."""
        new = np.flatnonzero(~nodes.known)
        if not len(new):
            return nodes
        some = take(nodes, new)
        bound, steps, price = self.ending(self.poses(some), self.target, some.control)
        self.test(some, steps, some.g + price, TESTED)
        f = np.full(len(nodes.x), -math.inf)
        f[new] = some.g + self.weight * bound
        nodes.known[new] = True
        later = (f / self.width) >= interval + 1
        self.put(take(nodes, later), f[later])
        return take(nodes, ~later)

    def test(self, nodes: _Nodes, steps: np.ndarray, price: np.ndarray, most: int) -> None:
        """Test the `most` cheapest connections for collisions.

        The other connections are stored, and tested when OPEN is empty.
        steps: the motions of the connections. price: their costs.
        """
        wanted = np.flatnonzero(price < self.price)
        wanted = wanted[np.argsort(price[wanted], kind="stable")]
        if len(wanted) > most:
            late = wanted[most:]
            self.untested.append((take(nodes, late), steps[late], price[late]))
        wanted = wanted[:most]
        if not len(wanted):
            return
        free = self.map.free_chains(self.poses(take(nodes, wanted)), steps[wanted], self.footprint)
        if free.any():
            at = wanted[np.argmax(free)]
            self.price, self.end = float(price[at]), (take(nodes, slice(at, at + 1)), steps[at])

    def expand(self, wave: _Nodes) -> None:
        """Mark the nodes of a wave as visited, and put their children into OPEN."""
        self.visited.append(wave)
        n = len(self.table.turns)
        x, y, heading = self.children(wave)
        cell, inside = self.cells(x, y, heading)
        g = wave.g[:, None] + self.prices[wave.control]
        h = self.around(x, y)
        wanted = np.flatnonzero(inside & (self.best[cell] > g) & (g + h < self.price))
        wanted = wanted[np.argsort(g.ravel()[wanted], kind="stable")]
        new = _Nodes(
            x.ravel()[wanted], y.ravel()[wanted], cell.ravel()[wanted], self.count + wanted // n,
            wanted % n, g.ravel()[wanted], np.zeros(len(wanted), bool),
        )  # fmt: skip
        _, kept = self.admit(wave, new, new.g, True, self.first_of(new.cell))
        self.count += len(wave.x)
        self.put(take(new, kept), new.g[kept] + self.weight * h.ravel()[wanted[kept]])

    def plan(self, last: _Nodes, connection: np.ndarray) -> tuple[Plan, np.ndarray]:
        """Make the plan through a node and its connection to the target. Return it with the path's
        steps (n, 3)."""
        poses, controls = self.way_to(last)
        size = np.abs(connection).max(1, initial=0.0)
        ends = connection[size > 1e-12 * (1 + size.max(initial=0.0))]
        steps = np.concatenate([self.controls.steps[controls], ends])
        chosen = np.concatenate([controls, np.full(len(ends), -1)])
        poses = np.concatenate([poses, chain(poses[-1], ends, np)[1:]])
        return Plan("found", self.price, poses, chosen, self.count), steps
