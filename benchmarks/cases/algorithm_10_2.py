"""Lynch & Park, *Modern Robotics*, Algorithm 10.2, as it is printed, with NumPy and heapq.

The oracle of the compiled planner: one node at a time, each integrated, each tested on its way.
Where the book leaves something open: OPEN is sorted by cost, and by age among equal costs. The
motion is free if all discs are, at the middles of so many equal parts of it that no point of the
footprint goes further than half a cell in one; radii are enlarged by half of that way.
"""

import heapq
import itertools
import math
from typing import NamedTuple

import numpy as np


class Node(NamedTuple):
    x: float
    y: float
    heading: float
    cost: int
    control: int
    parent: "Node | None"


class Found(NamedTuple):
    status: str
    cost: int | None
    poses: list
    controls: list
    expanded: int


def plan(grid, field, footprint, start, goal, controls, tolerance, headings, max_count) -> Found:
    """All arguments are as `rbjax.planning.grid_dijkstra` takes them; field is grid's."""
    values, h, origin = np.asarray(field.values), float(field.resolution), np.asarray(field.origin)
    centers, radii = np.asarray(footprint.centers), np.asarray(footprint.radii)
    ways = [
        controls.dt * (abs(v) + abs(w) * np.hypot(*centers.T))
        for v, w in zip(controls.speeds, controls.turn_rates, strict=True)
    ]
    parts = max(1, math.ceil(np.max(ways) / (h / 2)))

    def free(x, y, heading, radii):
        """Whether all discs are, at one pose or at several."""
        x, y, heading = (np.asarray(a)[..., None] for a in (x, y, heading))
        c, s = np.cos(heading), np.sin(heading)
        px = x + c * centers[:, 0] - s * centers[:, 1]
        py = y + s * centers[:, 0] + c * centers[:, 1]
        u, v = (px - origin[0]) / h + 0.5, (py - origin[1]) / h + 0.5
        i = np.clip(np.round(u), 0, values.shape[0] - 1).astype(int)
        j = np.clip(np.round(v), 0, values.shape[1] - 1).astype(int)
        return (values[i, j] - h * np.hypot(u - i, v - j) > radii).all()

    def integrated(node, v, w, t):
        """After a time (or several), with v and w constant."""
        heading = node.heading + w * t
        if w == 0:
            return node.x + v * t * np.cos(heading), node.y + v * t * np.sin(heading), heading
        r = v / w
        return (
            node.x + r * (np.sin(heading) - math.sin(node.heading)),
            node.y - r * (np.cos(heading) - math.cos(node.heading)),
            heading,
        )

    def cell(node):
        i, j = math.floor((node.x - origin[0]) / h), math.floor((node.y - origin[1]) / h)
        if not (0 <= i < grid.occupied.shape[0] and 0 <= j < grid.occupied.shape[1]):
            return None
        return i, j, round((node.heading - start[2]) * headings / (2 * math.pi)) % headings

    def is_goal(node):
        turn = math.remainder(node.heading - goal[2], 2 * math.pi)
        near = math.hypot(node.x - goal[0], node.y - goal[1]) <= tolerance[0]
        return near and abs(turn) <= tolerance[1]

    if not free(*start, radii):
        return Found("start in collision", None, [], [], 0)
    if not free(*goal, radii):
        return Found("goal in collision", None, [], [], 0)
    age = itertools.count()
    first = Node(*start, 0, -1, None)
    open_ = [(0, next(age), first)]
    occupied: set = set()
    counter = 1
    while open_ and counter <= max_count:
        current = heapq.heappop(open_)[2]
        if is_goal(current):
            cost, poses, used = current.cost, [], []
            while current is not None:
                poses.append(current[:3])
                used.append(current.control)
                current = current.parent
            return Found("found", cost, poses[::-1], used[-2::-1], counter - 1)
        if cell(current) in occupied:
            continue
        occupied.add(cell(current))
        counter += 1
        for c, (v, w) in enumerate(zip(controls.speeds, controls.turn_rates, strict=True)):
            wide = radii + ways[c] / (2 * parts)
            times = controls.dt * (np.arange(parts) + 0.5) / parts
            after = integrated(current, v, w, controls.dt)
            before = 0.0 if current.parent is None else controls.speeds[current.control]
            cost = current.cost + int(controls.costs[c]) + controls.reversal * int(before * v < 0)
            if current.parent is not None:
                last = controls.speeds[current.control], controls.turn_rates[current.control]
                bends = [w / v if v else 0.0 for v, w in (last, (v, w))]
                cost += controls.steering * int(not math.isclose(*bends))
            new = Node(*after, cost, c, current)
            if cell(new) is None:
                continue
            if free(*integrated(current, v, w, times), wide):
                heapq.heappush(open_, (cost, next(age), new))
    left = any(cell(node) not in occupied or is_goal(node) for _, _, node in open_)
    return Found("count exhausted" if left else "no path", None, [], [], counter - 1)
