"""Lower bounds of path lengths around obstacles, valid for every robot.

Let a robot's origin keep a distance of at least r from obstacles. It stays in passable cells,
which contain a point with that distance. The shortest path within them bends only at corners of
cells, so the graph has the corners as nodes. A straight piece of the path from one corner to
another crosses passable cells. The chain of moves (1,0), (1,1), (2,1) (and their rotations and
reflections) that follows it from below only uses corners of these cells. It is at most

    kappa = 1 / cos(phi / 2) = 1.0275,     phi = atan(1/2)

times as long. So D / kappa, with D the length of the shortest chain, is a lower bound of the path
between two corners. Between two points, the distances from their nearest corners are subtracted.

All moves are at least one cell long. Therefore all corners with D in [k, k + 1) cells are final
once the ones below k are: Dijkstra's algorithm can proceed by waves.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbjax.planning.maps.footprint import Footprint
from rbjax.planning.maps.occupancy import DistanceField

MOVES = [(i, j) for i in range(-2, 3) for j in range(-2, 3) if math.gcd(i, j) == 1]
KAPPA = 1 / math.cos(math.atan(0.5) / 2)


class HolonomicDistance:
    """Lower bounds of the path length from a footprint's origin to one point of a map."""

    def __init__(self, distances: DistanceField, footprint: Footprint, goal: Any):
        """Compute the bounds on a map. goal: (2,) m, on the map."""
        self.h, self.origin = float(distances.resolution), np.asarray(distances.origin, float)
        passable = np.asarray(distances.values)[1:-1, 1:-1] > _least(footprint, self.h)
        self.shape = tuple(n + 1 for n in passable.shape)
        at, self.off = self._corner(*np.asarray(goal, float)[:2])
        self.values = self.h * _from_corner(_touching(passable), at) / KAPPA

    def __call__(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Compute lower bounds (...) m of the path from positions (...) m to the goal. The bound is
        infinite if there is no path."""
        at, off = self._corner(x, y)
        return np.maximum(self.values[at] - off - self.off, 0.0)

    def _corner(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Find the index of the nearest corner, and its distance in m."""
        u, v = (x - self.origin[0]) / self.h, (y - self.origin[1]) / self.h
        i = np.clip(np.rint(u), 0, self.shape[0] - 1)
        j = np.clip(np.rint(v), 0, self.shape[1] - 1)
        return (i * self.shape[1] + j).astype(np.intp), self.h * np.hypot(u - i, v - j)


def _least(footprint: Footprint, h: float) -> float:
    """Compute a distance from obstacles that the centre of each passable cell exceeds.

    A free disc with centre c and radius r keeps the origin at least r - |c| away from obstacles,
    and the centre of its cell h / sqrt(2) less. If c is the origin, `clear` tests the cell itself.
    """
    away = np.hypot(*np.asarray(footprint.centers, float).T)
    lost = np.where(away > 0, away + h / math.sqrt(2), 0.0)
    return float((np.asarray(footprint.radii, float) - lost).max()) * (1 - 1e-9) - 1e-9 * h


def _touching(passable: np.ndarray) -> np.ndarray:
    """Return, for each corner (nx + 1, ny + 1), whether it belongs to a passable cell."""
    out = np.zeros((passable.shape[0] + 1, passable.shape[1] + 1), bool)
    for i in (slice(0, -1), slice(1, None)):
        for j in (slice(0, -1), slice(1, None)):
            out[i, j] |= passable
    return out


def _from_corner(open_: np.ndarray, at: int) -> np.ndarray:
    """Compute the lengths, in cells, of the shortest chains of moves from one corner to all
    corners, row by row.

    Moves are (1, 0), (1, 1) and (2, 1), rotated and mirrored. open_: the mask of usable corners.
    """
    rim = 2  # of the longest move, so that neighbours need no test of the map's edge
    wide = np.pad(open_, rim)
    ny = wide.shape[1]
    jumps = np.array([i * ny + j for i, j in MOVES])
    far = np.array([math.hypot(i, j) for i, j in MOVES])
    distance = np.where(wide.ravel(), np.inf, -1.0)  # closed corners are never improved
    i, j = divmod(int(at), open_.shape[1])
    first = (i + rim) * ny + j + rim
    distance[first] = 0.0
    shelves: list[list[np.ndarray]] = [[np.array([first])], [], [], []]  # by integer distance
    level = 0
    while any(shelves):
        shelf = shelves.pop(0)
        shelves.append([])
        if shelf:
            nodes = np.concatenate(shelf)
            nodes = np.unique(nodes[distance[nodes] >= level])  # the rest is final already
            to = (nodes[:, None] + jumps).ravel()
            length = (distance[nodes, None] + far).ravel()
            better = length < distance[to]
            to, length = to[better], length[better]
            np.minimum.at(distance, to, length)
            kept = length == distance[to]
            to, length = to[kept], length[kept]
            whole = length.astype(int) - level - 1
            for k in range(3):
                if (whole == k).any():
                    shelves[k].append(to[whole == k])
        level += 1
    out = np.where(wide.ravel(), distance, np.inf).reshape(wide.shape)
    return out[rim:-rim, rim:-rim].ravel()
