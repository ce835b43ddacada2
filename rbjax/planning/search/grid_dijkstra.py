"""Grid-based Dijkstra for a wheeled robot: Algorithm 10.2 of *Modern Robotics*, wave by wave.

    OPEN <- {start}
    while OPEN is not empty and fewer than max_count cells are visited:
        current <- the first node of OPEN, by cost and then by age
        if current is in the goal set: found
        if the cell of current is not visited yet:
            visit it
            for each control: integrate it for dt; if the motion is free, put its end into OPEN

A cell is (x, y, heading). A node keeps the configuration that was integrated, not its cell's
centre, so a path is exactly what the controls do. Cells only thin out the search: whoever comes
first to a cell stands for it. Therefore the cost is the least among paths of nodes that are kept,
not among all sequences of controls. With a price on reversals, a cell's visitor also decides the
direction of arrival.

Ties. Which of two nodes of equal cost is first decides which configuration stands for a cell, and
so the costs of those after it. The book leaves it open; here the older one is first, as in a queue.
Then the result is a function of the problem, which two programs can share.

Waves. With this rule the algorithm needs no heap. Costs of controls are positive integers, so what
is expanded at one cost goes to greater ones: all nodes of OPEN of one cost are a wave. In a wave,
by age, the first node of a cell that is not visited wins it. Children are appended in the order of
parents and of controls, which is that of their ages. So visited cells, their nodes, the path and
the count are exactly those of the heap, and a wave is a few operations on arrays.

Tests saved. A node of a visited cell can never win, nor one of a cell for which OPEN holds a free
node of no greater cost: such a node is left out before its motion is tested, unless it is in the
goal set. And where obstacles are further than the robot reaches in dt, motions need no test.

Another discretisation is the state lattice: motions end at cells' centres, all nodes of a cell
coincide, and Dijkstra's algorithm finds the least cost of all. It needs controls that are fitted to
the grid; Algorithm 10.2 takes any, as long as turns are multiples of a heading's cell. On motions
that end at centres, this file is Dijkstra's algorithm on the lattice.

Source: Lynch & Park, *Modern Robotics*, 10.4.2; Dial, Comm. ACM 12 (1969) 632, for the waves.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbjax.arguments import integer, real_array
from rbjax.errors import InputError
from rbjax.planning.maps.footprint import Footprint, clear
from rbjax.planning.maps.occupancy import DistanceField, OccupancyGrid
from rbjax.planning.paths.path import Plan
from rbjax.planning.search.controls import Controls, MotionTable
from rbjax.planning.search.swept_map import SweptMap

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
    """The cheapest sequence of controls that takes a robot to a goal on a grid of cells.

    Args:
        grid: the map; what is beyond it counts as occupied.
        footprint: what the robot covers.
        start, goal: poses (3,): x and y in m, the heading in rad.
        controls: each turns by a multiple of 2 pi / headings, and leaves a cell in its dt.
        tolerance: of the goal set: m from the goal's position, rad from its heading.
        headings: the number of cells of a turn.
        max_count: visit at most so many cells; None for all.

    Returns:
        `Plan`. A map without a path is a status, not an error.

    Raises:
        InputError: wrong types or shapes, values that are not finite, controls whose turns are no
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
    table = MotionTable.of(controls, footprint, start[2], headings, float(grid.resolution) / 2)
    distances = grid.distance_field()
    free = np.asarray(clear(distances, np.stack([start, goal]), footprint))
    if not free.all():
        return Plan("goal in collision" if free[0] else "start in collision")
    search = _Search(distances, controls, table, start, goal, tolerance)
    return search.run(NEVER if max_count is None else max_count)


class _Nodes(NamedTuple):
    """Nodes by age. Fields: x, y; cell; age; parent, the number of its visit; control."""

    x: np.ndarray
    y: np.ndarray
    cell: np.ndarray
    age: np.ndarray
    parent: np.ndarray
    control: np.ndarray

    def those(self, which: Any) -> _Nodes:
        return _Nodes(*(x[which] for x in self))


NOTHING = _Nodes(np.zeros(0), np.zeros(0), *np.zeros((4, 0), np.intp))


def _joined(parts: list[_Nodes]) -> _Nodes:
    return parts[0] if len(parts) == 1 else _Nodes(*map(np.concatenate, zip(*parts, strict=True)))


class _Search:
    """OPEN, by cost, and what is known of each cell."""

    def __init__(
        self, distances: DistanceField, controls: Controls, table: MotionTable,
        start: np.ndarray, goal: np.ndarray, tolerance: tuple[float, float],
    ):  # fmt: skip
        self.map = SweptMap(distances, table)
        self.h, self.origin = self.map.h, self.map.origin
        nx, ny = self.map.values.shape  # with a ring around the map
        self.shape = (nx - 2, ny - 2, len(table.headings))
        self.controls, self.table, self.start, self.goal = controls, table, start, goal
        self.prices = controls.prices
        self.near = tolerance[0]
        turn = np.abs(np.remainder(self.table.headings - goal[2] + math.pi, 2 * math.pi) - math.pi)
        self.towards = turn <= tolerance[1]
        size = math.prod(self.shape)
        self.best = np.full(size, NEVER)  # the least cost of a cell's nodes in OPEN
        self.first = np.empty(size, np.int32)
        self.open: dict[int, list[_Nodes]] = {}
        self.reached: dict[int, list[_Nodes]] = {}  # nodes in the goal set, by cost
        self.visited: list[_Nodes] = []
        self.age = 1

    def run(self, max_count: int) -> Plan:
        zero = np.zeros(1, np.intp)
        x, y = self.start[:1], self.start[1:2]
        cell, inside = self._cells(x, y, zero)
        if not inside[0]:
            return Plan("start in collision")
        first = _Nodes(x, y, cell, zero, zero - 1, zero - 1)
        self.best[cell] = 0
        self.open[0] = [first]
        if self._is_goal(x, y, zero)[0]:
            self.reached[0] = [first]
        count = 0
        while self.open or self.reached:
            cost = min([*self.open, *self.reached])
            wave = self._wave(cost)
            if cost in self.reached:
                last = _joined(self.reached[cost])
                oldest = int(last.age.argmin())
                last = last.those(slice(oldest, oldest + 1))
                before = count + int((wave.age < last.age).sum())
                if before < max_count:
                    return self._path(cost, last, before)
            if cost in self.reached or count + len(wave.age) > max_count:
                return Plan("count exhausted", expanded=max_count)
            self._expand(wave, cost, count)
            count += len(wave.age)
        return Plan("no path", expanded=count)

    def _wave(self, cost: int) -> _Nodes:
        """The nodes of a cost that win their cells."""
        nodes = _joined(self.open.pop(cost, [NOTHING]))
        return nodes.those(self.best[nodes.cell] == cost)

    def _expand(self, wave: _Nodes, cost: int, count: int) -> None:
        """Visits the nodes of a wave. `count` is the number of visits before it."""
        self.best[wave.cell] = VISITED
        self.visited.append(wave)
        n, k = len(self.table.turns), wave.cell % self.shape[2]
        x, y = (
            p[:, None] + step[k] for p, step in zip((wave.x, wave.y), self.table.step, strict=True)
        )
        heading = (k[:, None] + self.table.turns) % self.shape[2]
        cell, inside = self._cells(x, y, heading)
        new = _Nodes(
            x.ravel(), y.ravel(), cell.ravel(), self.age + np.arange(x.size),
            np.repeat(count + np.arange(len(k)), n), np.tile(np.arange(n), len(k)),
        )  # fmt: skip
        self.age += x.size
        goal = self._is_goal(x, y, heading).ravel()
        to = (cost + self.prices[wave.control]).ravel()
        wanted = np.flatnonzero(inside.ravel() & (goal | (self.best[new.cell] > to)))
        wanted = wanted[np.argsort(to[wanted], kind="stable")]  # by cost, and then by age
        self._admit(wave, new.those(wanted), goal[wanted], to[wanted], count)

    def _admit(
        self, wave: _Nodes, new: _Nodes, goal: np.ndarray, cost: np.ndarray, count: int
    ) -> None:
        """Puts new nodes, in the order of OPEN, into it: the first free one of each cell."""
        better = self.best[new.cell] > cost
        free = np.zeros(len(cost), bool)
        tests = goal | self._first_of(new.cell)
        for _ in range(2):  # the first of each cell; then the others, where that was not free
            some = np.flatnonzero(tests)
            parent = new.parent[some] - count
            k = wave.cell[parent] % self.shape[2]
            free[some] = self.map.free(wave.x[parent], wave.y[parent], k, new.control[some])
            kept = np.flatnonzero(free & better)
            kept = kept[self._first_of(new.cell[kept])]
            self.best[new.cell[kept]] = cost[kept]
            tests = ~tests & (self.best[new.cell] > cost)
        for shelf, some in ((self.open, kept), (self.reached, np.flatnonzero(free & goal))):
            nodes, at = new.those(some), cost[some]
            costs, first = np.unique(at, return_index=True)
            for each, *ends in zip(costs, first, [*first[1:], None], strict=False):
                shelf.setdefault(int(each), []).append(nodes.those(slice(*ends)))

    def _first_of(self, cell: np.ndarray) -> np.ndarray:
        """Whether each is the first of equal ones."""
        number = np.arange(len(cell), dtype=np.int32)
        self.first[cell[::-1]] = number[::-1]  # the last of several that are assigned stays
        return self.first[cell] == number

    def _cells(self, x: np.ndarray, y: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of cells (0 beyond the map), and whether they are on the map."""
        i, j = np.floor((x - self.origin[0]) / self.h), np.floor((y - self.origin[1]) / self.h)
        inside = (i >= 0) & (j >= 0) & (i < self.shape[0]) & (j < self.shape[1])
        cell = ((i * self.shape[1] + j) * self.shape[2] + k).astype(np.intp)
        return np.where(inside, cell, 0), inside

    def _is_goal(self, x: np.ndarray, y: np.ndarray, k: np.ndarray) -> np.ndarray:
        near = np.hypot(x - self.goal[0], y - self.goal[1]) <= self.near
        return near & self.towards[k]

    def _path(self, cost: int, last: _Nodes, count: int) -> Plan:
        """The way back to the start from a node in the goal set."""
        places, chosen = way_back(self.visited, last)
        poses = np.column_stack([places, self.table.along(self.start[2], chosen)])
        return Plan("found", cost, poses, chosen, count, self.controls.path(self.start, chosen))


def way_back(visited: list, last: Any) -> tuple[np.ndarray, np.ndarray]:
    """Places (n + 1, 2) and controls (n,) from the start to a node.

    visited: nodes of each wave, with the fields x, y, parent and control. last: one such node.
    """
    firsts = np.cumsum([0, *(len(wave.x) for wave in visited)])
    places: list[tuple[float, float]] = []
    used: list[int] = []
    node = last
    while True:
        places.append((node.x[0], node.y[0]))
        parent = int(node.parent[0])
        if parent < 0:
            return np.array(places[::-1]), np.array(used[::-1], int)
        used.append(int(node.control[0]))
        wave = int(np.searchsorted(firsts, parent, "right")) - 1
        node = visited[wave].those(np.array([parent - firsts[wave]]))


def check_poses(where: str, start: Any, goal: Any, axes: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Start and goal as arrays (3,), or of as many poses each (q, 3)."""
    shape = "(3,)" if axes == 1 else "(q, 3)"
    poses = []
    for name, x in (("start", start), ("goal", goal)):
        try:
            pose = np.asarray(x, float)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{where}: {name} is {type(x).__name__}, expected {shape}, numbers in m and rad"
            ) from error
        if pose.ndim != axes or pose.shape[-1] != 3 or not np.isfinite(pose).all():
            raise InputError(
                f"{where}: {name} is {pose}, expected {shape}, finite numbers in m and rad"
            )
        poses.append(pose)
    if poses[0].shape != poses[1].shape:
        raise InputError(
            f"{where}: got {len(poses[0])} starts and {len(poses[1])} goals, expected as many"
        )
    return poses[0], poses[1]


#: the largest numbers of cells of a turn, and of nodes that an index can count
MOST = {"headings": 100_000, "max_count": 2**31 - 1}


def check_problem(where: str, grid, footprint, controls, tolerance, headings, max_count) -> None:
    """Refuse arguments of a search that are no such thing."""
    for name, x, kind in (
        ("grid", grid, OccupancyGrid),
        ("footprint", footprint, Footprint),
        ("controls", controls, Controls),
    ):
        if not isinstance(x, kind):
            raise InputError(
                f"{where}: {name} is {type(x).__name__}, expected rb.planning.{kind.__name__}"
            )
    near = real_array(where, "tolerance", tolerance, "two numbers, m and rad")
    if near.shape != (2,) or not (near >= 0).all():
        raise InputError(f"{where}: tolerance is {tolerance!r}, expected two numbers, m and rad")
    for name, x in (("headings", headings), ("max_count", 1 if max_count is None else max_count)):
        if integer(where, name, x, least=1) > MOST[name]:
            raise InputError(f"{where}: {name} is {x:.3g}, expected at most {MOST[name]}")
