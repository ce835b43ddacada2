"""Common parts of the searches on the host: cells, nodes by cost, collision tests.

A search expands a wave of nodes at once, by array operations. Nodes are NamedTuples of arrays with
the fields x, y, cell, parent (the number of its visit, -1 for the root), control, and others.
"""

from __future__ import annotations

import math
from typing import Any, TypeVar

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, integer, real_array
from rbjax.errors import InputError
from rbjax.planning.maps.footprint import Footprint, clear
from rbjax.planning.maps.occupancy import DistanceField, OccupancyGrid
from rbjax.planning.paths.path import Plan, displacements
from rbjax.planning.search.controls import Controls, MotionTable

Nodes = TypeVar("Nodes", bound=tuple)
Shelves = dict[int, list[Nodes]]  # lists of nodes by an integer cost

#: the largest number of heading cells of a full turn, and of nodes that an index can count
LARGEST = {"headings": 100_000, "max_count": 2**31 - 1}


def take(nodes: Nodes, which: Any) -> Nodes:
    """Select nodes, in columns, by indices, a mask or a slice."""
    return type(nodes)(*(x[which] for x in nodes))


def join(parts: list[Nodes]) -> Nodes:
    """Concatenate lists of nodes."""
    if len(parts) == 1:
        return parts[0]
    return type(parts[0])(*map(np.concatenate, zip(*parts, strict=True)))


def add_to(shelves: Shelves, costs: np.ndarray, nodes: Any) -> None:
    """Add nodes to the lists by cost of `shelves`. costs: (n,), one for each node."""
    order = np.argsort(costs, kind="stable")
    values, first = np.unique(costs[order], return_index=True)
    for cost, *ends in zip(values, first, [*first[1:], None], strict=False):
        shelves.setdefault(int(cost), []).append(take(nodes, order[slice(*ends)]))


class SweptMap:
    """Collision tests of tabulated motions on a map, with discs that cover the swept footprint."""

    def __init__(self, distances: DistanceField, table: MotionTable):
        self.values = np.asarray(distances.values)
        self.h, self.origin = float(distances.resolution), np.asarray(distances.origin, float)
        self.controls = len(table.turns)
        motions = len(table.headings) * self.controls
        self.discs = table.discs.reshape(2, motions, -1)
        self.radii = table.radii.reshape(motions, -1)
        far = np.hypot(*self.discs) + self.radii
        # `below` is less than the distance by at most a diagonal of a cell
        self.safe = far.max() + self.h * math.sqrt(2) * (1 + 1e-9)

    def below(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Compute `DistanceField.below` in numpy. It is valid only if it is positive."""
        u = (x - self.origin[0]) * (1 / self.h) + 0.5
        v = (y - self.origin[1]) * (1 / self.h) + 0.5
        nx, ny = self.values.shape
        i = np.minimum(np.maximum(np.rint(u), 0), nx - 1)
        j = np.minimum(np.maximum(np.rint(v), 0), ny - 1)
        u -= i
        v -= j
        return self.values.ravel()[(i * ny + j).astype(np.intp)] - self.h * np.sqrt(u * u + v * v)

    def free(self, x: np.ndarray, y: np.ndarray, k: np.ndarray, control: np.ndarray) -> np.ndarray:
        """Test whether motions (n,) are free, from positions x, y (n,) m and heading indices k
        (n,)."""
        free = self.below(x, y) > self.safe
        test = np.flatnonzero(~free)
        motion = k[test] * self.controls + control[test]
        a, b = x[test, None] + self.discs[0][motion], y[test, None] + self.discs[1][motion]
        free[test] = (self.below(a, b) > self.radii[motion]).all(1)
        return free

    def free_chains(
        self, starts: np.ndarray, steps: np.ndarray, footprint: Footprint
    ) -> np.ndarray:
        """Test whether chains of steps (m, n, 3) from poses (m, 3) are free, as `clear_along`
        does."""
        centers, radii = np.asarray(footprint.centers, float), np.asarray(footprint.radii, float)
        way = np.hypot(steps[..., 0], steps[..., 1])[..., None] + np.abs(steps[..., 2:]) * np.hypot(
            *centers.T
        )
        parts = np.ceil(way.max(-1) / (self.h / 2)).astype(int)
        heads = starts[:, 2:] + np.cumsum(steps[..., 2], 1) - steps[..., 2]
        dx, dy = displacements(heads, steps, np)
        x, y = (starts[:, i, None] + np.cumsum(d, 1) - d for i, d in ((0, dx), (1, dy)))
        # one row for each part of each step
        row = np.repeat(np.arange(parts.size), parts.ravel())
        number = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts.ravel(), parts.ravel())
        share = (number + 0.5) / parts.ravel()[row]
        some = share[:, None] * steps.reshape(-1, 3)[row]
        heading = heads.ravel()[row]
        sx, sy = displacements(heading, some, np)
        heading = heading + some[:, 2]
        c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
        px = (x.ravel()[row] + sx)[:, None] + c * centers[:, 0] - s * centers[:, 1]
        py = (y.ravel()[row] + sy)[:, None] + s * centers[:, 0] + c * centers[:, 1]
        wide = radii + (way / np.maximum(2 * parts, 1)[..., None]).reshape(-1, len(radii))[row]
        hit = ~(self.below(px, py) > wide).all(1)
        free = np.ones(len(steps), bool)
        free[row[hit] // steps.shape[1]] = False
        return free


class WaveSearch:
    """Base of a search on cells (x, y, heading): OPEN, the least cost of each cell, visited
    nodes."""

    def __init__(
        self, distances: DistanceField, controls: Controls, table: MotionTable, root: np.ndarray,
        side: float, never: Any,
    ):  # fmt: skip
        """Prepare a search.

        root: (3,), the pose from which the search grows. side: the side of a cell, m.
        never: the cost of a cell without nodes, in the dtype of costs.
        """
        self.map, self.table, self.controls = SweptMap(distances, table), table, controls
        self.root, self.side, self.prices = root, side, controls.prices
        size = (np.array(distances.values.shape) - 2) * self.map.h  # without the ring
        self.shape = (*np.ceil(size / side * (1 - 1e-12)).astype(int), len(table.headings))
        self.best = np.full(math.prod(self.shape), never)
        self.first = np.empty(len(self.best), np.int32)
        self.open: Shelves = {}
        self.visited: list[Any] = []
        self.count = 0  # of visits

    def cells(self, x: np.ndarray, y: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices of cells (0 beyond the map), and whether they are on the map."""
        i, j = (np.floor((p - o) / self.side) for p, o in zip((x, y), self.map.origin, strict=True))
        inside = (i >= 0) & (j >= 0) & (i < self.shape[0]) & (j < self.shape[1])
        cell = ((i * self.shape[1] + j) * self.shape[2] + k).astype(np.intp)
        return np.where(inside, cell, 0), inside

    def children(self, wave: Any) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Compute x, y and the heading's index, each (n, controls), after each control from n
        nodes."""
        k = wave.cell % self.shape[2]
        x, y = (
            p[:, None] + step[k] for p, step in zip((wave.x, wave.y), self.table.step, strict=True)
        )
        return x, y, (k[:, None] + self.table.turns) % self.shape[2]

    def admit(
        self, wave: Any, new: Any, cost: np.ndarray, better: Any, tests: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Select the first free child of each cell. Return which children (m,) are known to be
        free, and the indices of the selected ones.

        `cost` (m,) is in ascending order. `better` (m,) is whether it is below the cost of the
        cell. The first pass tests the motions of `tests` (m,); the second tests the rest, if their
        cells still have no node of the same or lower cost.
        """
        free = np.zeros(len(cost), bool)
        kept = np.zeros(0, np.intp)
        for _ in range(2):
            some = np.flatnonzero(tests)
            parent = new.parent[some] - self.count
            k = wave.cell[parent] % self.shape[2]
            free[some] = self.map.free(wave.x[parent], wave.y[parent], k, new.control[some])
            kept = np.flatnonzero(free & better)
            kept = kept[self.first_of(new.cell[kept])]
            self.best[new.cell[kept]] = cost[kept]
            tests = ~tests & (self.best[new.cell] > cost)
        return free, kept

    def first_of(self, cell: np.ndarray) -> np.ndarray:
        """Return, for each cell index, whether it is the first occurrence of its value."""
        number = np.arange(len(cell), dtype=np.int32)
        self.first[cell[::-1]] = number[::-1]  # of several assignments, the last one remains
        return self.first[cell] == number

    def way_to(self, last: Any) -> tuple[np.ndarray, np.ndarray]:
        """Trace the path from the root to a node. Return its poses (n + 1, 3) and controls (n,).

        last: the node, as a record of nodes with one entry.
        """
        firsts = np.cumsum([0, *(len(wave.x) for wave in self.visited)])
        places: list[tuple[float, float]] = []
        used: list[int] = []
        node = last
        while True:
            places.append((node.x[0], node.y[0]))
            parent = int(node.parent[0])
            if parent < 0:
                break
            used.append(int(node.control[0]))
            wave = int(np.searchsorted(firsts, parent, "right")) - 1
            node = take(self.visited[wave], np.array([parent - firsts[wave]]))
        controls = np.array(used[::-1], int)
        headings = self.table.along(self.root[2], controls)
        return np.column_stack([np.array(places[::-1]), headings]), controls


def collision(
    distances: DistanceField, footprint: Footprint, start: np.ndarray, goal: np.ndarray
) -> Plan | None:
    """Return the plan of a search whose start or goal is in collision, or None if both are free."""
    free = np.asarray(clear(distances, jnp.stack([start, goal]), footprint))
    if free.all():
        return None
    return Plan("goal in collision" if free[0] else "start in collision")


def check_poses(where: str, start: Any, goal: Any, axes: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Check start and goal, and convert them to arrays (3,), or (q, 3) each if `axes` is 2."""
    shape = "(3,)" if axes == 1 else "(q, 3)"
    poses = []
    several = "s" if axes == 2 else ""
    for name, x in ((f"start{several}", start), (f"goal{several}", goal)):
        pose = real_array(where, name, x, f"{shape}, finite numbers in m and rad")
        if pose.ndim != axes or pose.shape[-1] != 3:
            raise InputError(
                f"{where}: {name} is {pose}, expected {shape}, finite numbers in m and rad"
            )
        poses.append(pose)
    if poses[0].shape != poses[1].shape:
        raise InputError(
            f"{where}: got {len(poses[0])} starts and {len(poses[1])} goals, expected as many"
        )
    return poses[0], poses[1]


def check_problem(
    where: str, grid: Any, footprint: Any, controls: Any, tolerance: Any, headings: Any,
    max_count: Any,
) -> None:  # fmt: skip
    """Check the arguments that all searches have in common."""
    for name, x, kind in (
        ("grid", grid, OccupancyGrid), ("footprint", footprint, Footprint),
        ("controls", controls, Controls),
    ):  # fmt: skip
        instance(where, name, x, kind, f"rb.planning.{kind.__name__}")
    near = real_array(where, "tolerance", tolerance, "two numbers, m and rad")
    if near.shape != (2,) or not (near >= 0).all():
        raise InputError(f"{where}: tolerance is {tolerance!r}, expected two numbers, m and rad")
    for name, x in (("headings", headings), ("max_count", 1 if max_count is None else max_count)):
        if integer(where, name, x, least=1) > LARGEST[name]:
            raise InputError(f"{where}: {name} is {x:.3g}, expected at most {LARGEST[name]}")
