"""Many grid searches on one map at once, for an accelerator: batched `grid_dijkstra`.

Each search has its own cells, so the nodes of one cost of all searches form one wave. Nodes are
stored in one list, by age. All nodes of cost c were appended since the wave of cost c - w, with w
the largest cost of a step. A wave is expanded in parts of constant size, by age, since compiled
programs need constant shapes. For each search, the visited cells, their nodes, the path and the
count are the same as by `grid_dijkstra`, except for rounding if a node is on the edge of a cell.
"""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import wide_vectors
from rbjax.model.record import Record
from rbjax.planning.maps.footprint import Footprint, clear
from rbjax.planning.maps.occupancy import DistanceField, OccupancyGrid
from rbjax.planning.paths.path import Plan
from rbjax.planning.search.controls import Controls, MotionTable
from rbjax.planning.search.wave_search import check_poses, check_problem

NEVER = np.iinfo(np.int32).max
SEARCHING, FOUND, EXHAUSTED = range(3)
LEAST, MOST = 512, 65536  # nodes expanded at once


class _Problem(Record):
    """The data of q searches: n controls, tabulated for K headings, with m discs that cover each
    motion."""

    distances: DistanceField
    start: jax.Array  # (q, 3)
    goal: jax.Array  # (q, 3)
    step: jax.Array  # (2, K * n), for a first heading of zero
    discs: jax.Array  # (2, K * n, m)
    radii: jax.Array  # (K * n, m)
    turns: jax.Array  # (n,)
    prices: jax.Array  # (n + 1, n)
    tolerance: jax.Array  # (2,)
    max_count: jax.Array

    @property
    def headings(self) -> int:
        return self.step.shape[1] // self.turns.shape[0]

    def cells(self, x: jax.Array, y: jax.Array, k: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the indices of cells (0 beyond the map), and whether they are on the map."""
        nx, ny = (n - 2 for n in self.distances.values.shape)
        origin, h = self.distances.origin, self.distances.resolution
        i, j = jnp.floor((x - origin[0]) / h), jnp.floor((y - origin[1]) / h)
        inside = (i >= 0) & (j >= 0) & (i < nx) & (j < ny)
        cell = (i * ny + j).astype(jnp.int32) * self.headings + k
        return jnp.where(inside, cell, 0), inside

    def is_goal(self, search: jax.Array, x: jax.Array, y: jax.Array, k: jax.Array) -> jax.Array:
        goal = self.goal[search]
        turn = self.start[search, 2] + 2 * math.pi / self.headings * k - goal[..., 2]
        turn = jnp.abs(jnp.remainder(turn + math.pi, 2 * math.pi) - math.pi)
        near = jnp.hypot(x - goal[..., 0], y - goal[..., 1]) <= self.tolerance[0]
        return near & (turn <= self.tolerance[1])


class _Nodes(Record):
    """Nodes of all searches, ordered by age."""

    x: jax.Array  # x and y: position, m
    y: jax.Array
    search: jax.Array  # index of the search
    cell: jax.Array  # index of the cell
    parent: jax.Array  # index of the parent node, -1 for a start
    control: jax.Array  # index of the control that leads to the node, -1 for a start
    cost: jax.Array  # -1 of a node that represents no cell and is only in the goal set


class _Searches(Record):
    """Variables of all searches."""

    nodes: _Nodes
    size: jax.Array  # the number of stored nodes
    best: jax.Array  # (q, cells), the least cost of a cell's nodes in OPEN, -1 once visited
    first: jax.Array  # (q, cells), work array for the first node of a cell
    sizes: jax.Array  # (w,), the numbers of nodes before the last w waves
    cost: jax.Array  # of the current wave
    last: jax.Array  # the largest cost of a stored node
    reached: jax.Array  # (q,), the index of the first node in the goal set
    at: jax.Array  # (q,), the cost of that node
    status: jax.Array  # (q,), SEARCHING, FOUND or EXHAUSTED
    visited: jax.Array  # (q,), the number of visited cells


def _turned(angle: jax.Array, v: jax.Array) -> tuple[jax.Array, jax.Array]:
    c, s = jnp.cos(angle), jnp.sin(angle)
    return c * v[0] - s * v[1], s * v[0] + c * v[1]


def _children(p: _Problem, s: _Searches, at: jax.Array) -> tuple[_Nodes, jax.Array, jax.Array]:
    """Compute the ends of all controls from nodes `at`, by parent and then by control. Also return
    whether they are on the map, and whether their motions are free."""
    n, old = p.turns.shape[0], jax.tree.map(lambda a: a[at], s.nodes)
    k, angle = old.cell % p.headings, p.start[old.search, 2][:, None]
    motion = k[:, None] * n + jnp.arange(n)
    dx, dy = _turned(angle, p.step[:, motion])
    x, y = old.x[:, None] + dx, old.y[:, None] + dy
    cell, inside = p.cells(x, y, (k[:, None] + p.turns) % p.headings)
    cost = s.cost + p.prices[old.control]
    rest = jnp.broadcast_arrays(old.search[:, None], cell, at[:, None], jnp.arange(n), cost)
    a, b = _turned(angle[..., None], p.discs[:, motion])
    centers = jnp.stack([old.x[:, None, None] + a, old.y[:, None, None] + b], -1)
    free = (p.distances.below(centers) > p.radii[motion]).all(-1)
    return _Nodes(*(r.ravel() for r in (x, y, *rest))), inside.ravel(), free.ravel()


def _expand(p: _Problem, s: _Searches, at: jax.Array, valid: jax.Array) -> _Searches:
    """Visit the valid nodes among `at`, and store their children. An index out of range is
    dropped."""
    searches = s.best.shape[0]
    here = jnp.where(valid, s.nodes.search[at], searches)
    best = s.best.at[here, s.nodes.cell[at]].set(-1, mode="drop")
    visited = s.visited.at[here].add(1, mode="drop")

    new, inside, free = _children(p, s, at)
    free = free & inside & jnp.repeat(valid, p.turns.shape[0])
    goal = free & p.is_goal(new.search, new.x, new.y, new.cell % p.headings)
    better = free & (best[new.search, new.cell] > new.cost)
    # the first of a cell, by cost and then by age
    number = jnp.arange(new.x.size, dtype=jnp.int32) + new.x.size * (new.cost - s.cost)
    which = jnp.where(better, new.search, searches)
    first = s.first.at[which, new.cell].min(number, mode="drop")
    least = first[new.search, new.cell]
    wins = better & (least == number)
    # cleared only after it was read: the data dependence lets XLA update in place
    first = first.at[jnp.where(least < NEVER, which, searches), new.cell].set(NEVER, mode="drop")
    best = best.at[jnp.where(wins, new.search, searches), new.cell].min(new.cost, mode="drop")

    stored = wins | goal
    place = (s.size + jnp.cumsum(stored) - 1).astype(jnp.int32)
    to = jnp.where(stored, place, s.nodes.x.shape[0])
    kept = dataclasses.replace(new, cost=jnp.where(wins, new.cost, -1))
    nodes = jax.tree.map(lambda a, b: a.at[to].set(b.astype(a.dtype), mode="drop"), s.nodes, kept)
    cheapest = s.at.at[jnp.where(goal, new.search, searches)].min(new.cost, mode="drop")
    reached = jnp.where(cheapest < s.at, NEVER, s.reached)
    soonest = jnp.where(goal & (new.cost == cheapest[new.search]), new.search, searches)
    return dataclasses.replace(
        s, nodes=nodes, size=s.size + stored.sum(dtype=jnp.int32), best=best, first=first,
        last=jnp.maximum(s.last, jnp.where(stored, new.cost, 0).max()),
        reached=reached.at[soonest].min(place, mode="drop"), at=cheapest, visited=visited,
    )  # fmt: skip


def _wave(p: _Problem, s: _Searches, width: int) -> _Searches:
    """Expand all nodes of the current cost. In searches whose goal is reached at this cost, only
    nodes older than the goal's node are expanded.

    width: the number of nodes that are expanded at once, a constant shape of the program.
    """
    looked = 4 * width  # stored nodes that are scanned at once for members of the wave
    slot = s.cost % s.sizes.shape[0]
    low, high = s.sizes[slot], s.size
    s = dataclasses.replace(s, sizes=s.sizes.at[slot].set(s.size))
    limit = jnp.where(s.at == s.cost, s.reached, NEVER)

    def part(x: tuple[jax.Array, _Searches]) -> tuple[jax.Array, _Searches]:
        begin, s = x
        at = begin + jnp.arange(looked, dtype=jnp.int32)
        search, cell, cost = (a[at] for a in (s.nodes.search, s.nodes.cell, s.nodes.cost))
        member = (at < high) & (cost == s.cost) & (s.best[search, cell] == s.cost)
        member &= (s.status[search] == SEARCHING) & (at < limit[search])
        place = jnp.where(member, jnp.cumsum(member) - 1, looked + width)
        members = jnp.zeros(looked + width, jnp.int32).at[place].set(at, mode="drop")
        count = member.sum(dtype=jnp.int32)

        def some(y: tuple[jax.Array, _Searches]) -> tuple[jax.Array, _Searches]:
            done, s = y
            chosen = jax.lax.dynamic_slice(members, (done,), (width,))
            return done + width, _expand(p, s, chosen, done + jnp.arange(width) < count)

        _, s = jax.lax.while_loop(lambda y: y[0] < count, some, (jnp.int32(0), s))
        return begin + looked, s

    _, s = jax.lax.while_loop(lambda x: x[0] < high, part, (low, s))
    at_goal = s.at == s.cost
    searching = s.status == SEARCHING
    over = jnp.where(at_goal, s.visited >= p.max_count, s.visited > p.max_count)
    over = over | (s.size > s.nodes.x.shape[0])
    status = jnp.where(searching & at_goal, FOUND, s.status)
    status = jnp.where(searching & over, EXHAUSTED, status)
    visited = jnp.where(searching & over, jnp.minimum(s.visited, p.max_count), s.visited)
    return dataclasses.replace(s, status=status, visited=visited, cost=s.cost + 1)


def _run(p: _Problem, s: _Searches, width: int) -> _Searches:
    def goes_on(s: _Searches) -> jax.Array:
        return (s.status == SEARCHING).any() & (s.cost <= s.last)

    return jax.lax.while_loop(goes_on, lambda s: _wave(p, s, width), s)


def grid_dijkstra_many(
    grid: OccupancyGrid,
    footprint: Footprint,
    starts: Any,
    goals: Any,
    controls: Controls,
    tolerance: tuple[float, float] = (0.1, 0.1),
    headings: int = 72,
    max_count: int | None = None,
    nodes: int | None = None,
) -> list[Plan]:
    """Run `grid_dijkstra` from q starts to q goals on one map, all at once.

    Use it on accelerators. On a CPU, sequential calls of `grid_dijkstra` are faster. It requires 8
    bytes per cell of each search, and 28 bytes per node (36 in f64).

    Args:
        grid, footprint, controls, tolerance, headings, max_count: as for `grid_dijkstra`.
        starts, goals: poses (q, 3): x and y in m, the heading in rad.
        nodes: the largest number of nodes of all searches; None for a quarter of the cells.
            Searches that are not finished by then have the status "count exhausted".

    Returns:
        A list of q `Plan`.

    Raises:
        InputError: as for `grid_dijkstra`.

    Example:
        >>> grid = OccupancyGrid(np.zeros((20, 20), bool), 0.1)
        >>> car = Controls.car(radius=0.3, turn=np.deg2rad(30.0))
        >>> starts, goals = [[0.5, 0.5, 0.0], [0.5, 1.5, 0.0]], [[1.5, 0.5, 0.0], [9.0, 0.5, 0.0]]
        >>> plans = grid_dijkstra_many(grid, Footprint.disc(0.1), starts, goals, car, headings=12)
        >>> [plan.status for plan in plans]
        ['found', 'goal in collision']
    """
    where = "grid_dijkstra_many"
    check_problem(where, grid, footprint, controls, tolerance, headings, max_count)
    starts, goals = check_poses(where, starts, goals, 2)
    distances = grid.distance_field()
    bad = [np.asarray(~clear(distances, poses, footprint)) for poses in (starts, goals)]
    table = MotionTable.of(controls, footprint, 0.0, headings, float(grid.resolution) / 2)
    real = distances.values.dtype
    motions = headings * len(table.turns)
    problem = _Problem(
        distances, jnp.asarray(starts, real), jnp.asarray(goals, real),
        jnp.asarray(table.step.reshape(2, motions), real),
        jnp.asarray(table.discs.reshape(2, motions, -1), real),
        jnp.asarray(table.radii.reshape(motions, -1), real),
        jnp.asarray(table.turns, jnp.int32), jnp.asarray(controls.prices, jnp.int32),
        jnp.asarray(tolerance, real), jnp.int32(NEVER if max_count is None else max_count),
    )  # fmt: skip
    dearest = int(controls.prices.max())
    width = min(MOST, max(LEAST, 64 * len(starts)), 2**30 // (len(table.turns) * dearest))
    room = grid.occupied.size * headings * len(starts) // 4 if nodes is None else nodes
    searches = _first_state(problem, bad[0] | bad[1], min(room, NEVER), dearest)
    run = jax.jit(_run, compiler_options=wide_vectors(), static_argnums=2, donate_argnums=1)
    return _plans(run(problem, searches, width), bad, table, starts, controls)


def _first_state(p: _Problem, bad: np.ndarray, room: int, dearest: int) -> _Searches:
    """Make the state of all searches before the first wave. The only nodes are the starts.

    bad: (q,), whether a start or goal is in collision. room: the number of nodes to allocate.
    dearest: the largest cost of a step.
    """
    q, zero = len(bad), jnp.zeros(len(bad), jnp.int32)
    search = jnp.arange(q, dtype=jnp.int32)
    x, y = p.start[:, 0], p.start[:, 1]
    cell, inside = p.cells(x, y, zero)
    nx, ny = (n - 2 for n in p.distances.values.shape)
    empty = jnp.full((q, nx * ny * p.headings), NEVER, jnp.int32)
    first = _Nodes(x, y, search, cell, zero - 1, zero - 1, zero)
    there = p.is_goal(search, x, y, zero)
    return _Searches(
        nodes=jax.tree.map(lambda a: jnp.zeros(max(room, q), a.dtype).at[:q].set(a), first),
        size=jnp.int32(q), best=empty.at[search, cell].set(0), first=empty,
        sizes=jnp.zeros(dearest, jnp.int32), cost=jnp.int32(0), last=jnp.int32(0),
        reached=jnp.where(there, search, NEVER), at=jnp.where(there, 0, NEVER),
        status=jnp.where(jnp.asarray(bad) | ~inside, EXHAUSTED, SEARCHING), visited=zero,
    )  # fmt: skip


def _plans(
    s: _Searches, bad: list[np.ndarray], table: MotionTable, starts: np.ndarray,
    controls: Controls,
) -> list[Plan]:  # fmt: skip
    status, visited, cost = (np.asarray(a) for a in (s.status, s.visited, s.at))
    found = status == FOUND
    node = jnp.where(found, s.reached, -1)
    ways = []  # step by step backwards: x, y, control of each search
    while (node >= 0).any():
        ways.append([np.asarray(a[node]) for a in (s.nodes.x, s.nodes.y, s.nodes.control)])
        ways[-1].append(np.asarray(node) >= 0)  # whether the search goes back as far
        node = jnp.where(node >= 0, s.nodes.parent[node], -1)
    x, y, control, on = np.moveaxis(np.reshape(ways, (-1, 4, len(starts))), 1, 0)
    plans = []
    for i, start in enumerate(starts):
        if bad[0][i] or bad[1][i]:
            plans.append(Plan("start in collision" if bad[0][i] else "goal in collision"))
        elif not found[i]:
            name = "count exhausted" if status[i] == EXHAUSTED else "no path"
            plans.append(Plan(name, expanded=int(visited[i])))
        else:
            some = slice(int(on[:, i].sum()) - 1, None, -1)
            chosen = control[some, i][1:].astype(int)
            poses = np.column_stack([x[some, i], y[some, i], table.along(start[2], chosen)])
            path = controls.path(start, chosen)
            plans.append(Plan("found", int(cost[i]), poses, chosen, int(visited[i]), path))
    return plans
