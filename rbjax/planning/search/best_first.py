"""The search of A*: nodes of least f first, many at once.

    OPEN <- {root};  f(node) = g(node) + weight * h(node)
    while a node of OPEN has f less than the price of the best path:
        for the nodes of least f: end the way at the target, if that is possible: a path. Then, for
            each control: integrate it for dt; if the motion is free, and the cell of its end holds
            no node of no greater g, put its end into OPEN

g is the price of the way to a node, as `Controls` counts it. h is the greater of two lower bounds
of the way on: that of the ending without obstacles (`ending`), and the way of a point around them
(`holonomic`). So the price found is at most `weight` times the least one among the paths of nodes
that are kept. As in `grid_dijkstra`, a cell keeps one node at a time; here a cheaper one takes its
place, and is expanded again. Therefore nodes can be expanded in any order: as many at once as make
operations on arrays worth while.

The ending is computed for nodes of least f only. If its bound is greater than the other one, the
node returns to OPEN with its new f.

Source: Hart, Nilsson & Raphael, IEEE Trans. SSC 4 (1968) 100; Pohl, Artificial Intelligence 1
(1970) 193, for the weight.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbjax.errors import InputError
from rbjax.planning.maps.footprint import Footprint
from rbjax.planning.maps.occupancy import DistanceField
from rbjax.planning.paths.path import Plan, chain
from rbjax.planning.search.controls import Controls, MotionTable
from rbjax.planning.search.ending import Direct, GoalSet
from rbjax.planning.search.grid_dijkstra import NEVER, way_back
from rbjax.planning.search.holonomic import HolonomicDistance
from rbjax.planning.search.swept_map import SweptMap

#: the largest number of cells of a search: 4 GB of costs and indices
MOST_CELLS = 500_000_000

MOST = np.iinfo(np.int32).max
FEW = 64  # nodes that are expanded at once, at least, from intervals one after the other
AT_ONCE = 32  # connections that are tested in a wave, those of least price


class _Nodes(NamedTuple):
    """Fields: x, y; cell; parent, the number of its visit; control; g; known, whether f has the
    bound of the direct connection already."""

    x: np.ndarray
    y: np.ndarray
    cell: np.ndarray
    parent: np.ndarray
    control: np.ndarray
    g: np.ndarray
    known: np.ndarray

    def those(self, which: Any) -> _Nodes:
        return _Nodes(*(x[which] for x in self))

    def joined(self, other: list[_Nodes]) -> _Nodes:
        return _Nodes(*map(np.concatenate, zip(self, *other, strict=True))) if other else self


class Search:
    """OPEN by intervals of f, and the least g of each cell."""

    def __init__(
        self, distances: DistanceField, footprint: Footprint, controls: Controls,
        table: MotionTable, ends: np.ndarray, cell: float, weight: float, ending: Direct | GoalSet,
    ):  # fmt: skip
        self.map, self.footprint, self.table = SweptMap(distances, table), footprint, table
        self.root, self.target = ends
        self.ending, self.weight, self.side = ending, weight, cell
        self.holonomic = HolonomicDistance(distances, footprint, self.target)
        self.prices, self.width = controls.prices, float(controls.costs.min())
        self.steps = controls.steps
        size = (np.array(distances.values.shape) - 2) * self.map.h
        count = np.ceil(size / cell * (1 - 1e-12))
        if count.prod() * len(table.headings) > MOST_CELLS:
            raise InputError(
                f"hybrid_a_star: cell is {cell}, which makes {count.prod():.3g} cells for each of "
                f"{len(table.headings)} headings, expected at most {MOST_CELLS:,} cells in all"
            )
        self.shape = (*count.astype(int), len(table.headings))
        self.size = size
        self.least = np.full(math.prod(self.shape), MOST, np.int32)  # the least g of a cell's nodes
        self.first = np.empty(len(self.least), np.int32)
        self.open: dict[int, list[_Nodes]] = {}
        self.visited: list[_Nodes] = []
        self.count = 0
        self.best = math.inf  # the price of the best path
        self.end: tuple[_Nodes, np.ndarray] | None = None  # its last node, and its connection
        self.untested: list[tuple[_Nodes, np.ndarray, np.ndarray]] = []

    def run(self, max_count: int | None) -> tuple[Plan, np.ndarray]:
        """A plan from the root to the target, and its steps."""
        max_count = NEVER if max_count is None else max_count
        zero = np.zeros(1, np.intp)
        x, y = self.root[:1], self.root[1:2]
        cell, _ = self._cells(x, y, zero)
        first = _Nodes(x, y, cell, zero - 1, zero - 1, zero, np.zeros(1, bool))
        self.least[cell] = 0
        far = self._around(x, y)
        if not np.isfinite(far).all():
            return Plan("no path"), np.zeros((0, 3))
        self._put(first, self.weight * far)
        exhausted = False
        while self.open and not exhausted:
            if min(self.open) * self.width >= self.best:
                break
            nodes = self._looked_at(*self._cheapest())
            exhausted = self.count + len(nodes.x) > max_count
            self._expand(nodes.those(slice(max_count - self.count)))
        for nodes, steps, price in self.untested:
            self._connect(nodes, steps, price, len(price))
        if self.end is None:
            status = "count exhausted" if exhausted else "no path"
            return Plan(status, expanded=self.count), np.zeros((0, 3))
        return self._plan(*self.end)

    def _around(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """The bound of the price on the way around obstacles."""
        return self.ending.rate * np.maximum(self.holonomic(x, y) - self.ending.near, 0.0)

    def _put(self, nodes: _Nodes, f: np.ndarray) -> None:
        interval = (f / self.width).astype(int)
        order = np.argsort(interval, kind="stable")
        values, first = np.unique(interval[order], return_index=True)
        for each, *ends in zip(values, first, [*first[1:], None], strict=False):
            self.open.setdefault(int(each), []).append(nodes.those(order[slice(*ends)]))

    def _cheapest(self) -> tuple[_Nodes, int]:
        """The nodes of least f that stand for their cells, and the last interval that they are
        of."""
        some: list[_Nodes] = []
        number = 0
        for interval in sorted(self.open):
            if number >= FEW or interval * self.width >= self.best:
                break
            first, *others = self.open.pop(interval)
            nodes = first.joined(others)
            some.append(nodes.those(self.least[nodes.cell] == nodes.g))
            number += len(some[-1].x)
            last = interval
        return some[0].joined(some[1:]), last

    def _looked_at(self, nodes: _Nodes, interval: int) -> _Nodes:
        """Nodes connected with the target, but for those that the connection moves beyond the
        interval; they are put back."""
        new = np.flatnonzero(~nodes.known)
        if not len(new):
            return nodes
        some = nodes.those(new)
        headings = self.table.headings[some.cell % self.shape[2]]
        poses = np.column_stack([some.x, some.y, headings])
        bound, steps, price = self.ending(poses, self.target, some.control)
        price = some.g + price
        self._connect(some, steps, price, AT_ONCE)
        f = np.full(len(nodes.x), -math.inf)
        f[new] = some.g + self.weight * bound
        nodes.known[new] = True
        later = (f / self.width) >= interval + 1
        self._put(nodes.those(later), f[later])
        return nodes.those(~later)

    def _connect(self, nodes: _Nodes, steps: np.ndarray, price: np.ndarray, most: int) -> None:
        """Test the cheapest connections. Keep the others for a test after the search of OPEN."""
        wanted = np.flatnonzero(price < self.best)
        wanted = wanted[np.argsort(price[wanted], kind="stable")]
        if len(wanted) > most:
            late = wanted[most:]
            self.untested.append((nodes.those(late), steps[late], price[late]))
        wanted = wanted[:most]
        if not len(wanted):
            return
        headings = self.table.headings[nodes.cell[wanted] % self.shape[2]]
        starts = np.column_stack([nodes.x[wanted], nodes.y[wanted], headings])
        free = self.map.free_chains(starts, steps[wanted], self.footprint)
        if free.any():
            at = wanted[np.argmax(free)]
            self.best, self.end = float(price[at]), (nodes.those(slice(at, at + 1)), steps[at])

    def _expand(self, wave: _Nodes) -> None:
        self.visited.append(wave)
        n, k = len(self.table.turns), wave.cell % self.shape[2]
        x, y = (
            p[:, None] + step[k] for p, step in zip((wave.x, wave.y), self.table.step, strict=True)
        )
        cell, inside = self._cells(x, y, (k[:, None] + self.table.turns) % self.shape[2])
        g = wave.g[:, None] + self.prices[wave.control]
        h = self._around(x, y)
        wanted = np.flatnonzero(inside & (self.least[cell] > g) & (g + h < self.best))
        wanted = wanted[np.argsort(g.ravel()[wanted], kind="stable")]
        parent, control = wanted // n, wanted % n
        new = _Nodes(
            x.ravel()[wanted], y.ravel()[wanted], cell.ravel()[wanted], self.count + parent,
            control, g.ravel()[wanted], np.zeros(len(wanted), bool),
        )  # fmt: skip
        free = np.zeros(len(wanted), bool)
        tests = self._first_of(new.cell)
        for _ in range(2):  # the first of each cell; then the others, where that was not free
            some = np.flatnonzero(tests)
            of = parent[some]
            free[some] = self.map.free(wave.x[of], wave.y[of], k[of], control[some])
            kept = np.flatnonzero(free & (self.least[new.cell] > new.g))
            kept = kept[self._first_of(new.cell[kept])]
            self.least[new.cell[kept]] = new.g[kept]
            tests = ~tests & (self.least[new.cell] > new.g)
        kept = np.flatnonzero(free & (self.least[new.cell] == new.g))
        kept = kept[self._first_of(new.cell[kept])]
        self.count += len(wave.x)
        self._put(new.those(kept), new.g[kept] + self.weight * h.ravel()[wanted[kept]])

    def _first_of(self, cell: np.ndarray) -> np.ndarray:
        """Whether each is the first of equal ones."""
        number = np.arange(len(cell), dtype=np.int32)
        self.first[cell[::-1]] = number[::-1]  # the last of several that are assigned stays
        return self.first[cell] == number

    def _cells(self, x: np.ndarray, y: np.ndarray, k: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Numbers of cells (0 beyond the map), and whether they are on the map."""
        u, v = x - self.map.origin[0], y - self.map.origin[1]
        inside = (u >= 0) & (v >= 0) & (u < self.size[0]) & (v < self.size[1])
        i, j = np.floor(u / self.side), np.floor(v / self.side)
        cell = ((i * self.shape[1] + j) * self.shape[2] + k).astype(np.intp)
        return np.where(inside, cell, 0), inside

    def _plan(self, last: _Nodes, connection: np.ndarray) -> tuple[Plan, np.ndarray]:
        places, controls = way_back(self.visited, last)
        size = np.abs(connection).max(1, initial=0.0)
        ends = connection[size > 1e-12 * (1 + size.max(initial=0.0))]
        steps = np.concatenate([self.steps[controls], ends])
        poses = np.column_stack([places, self.table.along(self.root[2], controls)])
        chosen = np.concatenate([controls, np.full(len(ends), -1)])
        poses = np.concatenate([poses, chain(poses[-1], ends, np)[1:]])
        return Plan("found", self.best, poses, chosen, self.count), steps
