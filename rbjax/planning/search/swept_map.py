"""Which motions of a table are free of obstacles on a map, for searches on the host."""

from __future__ import annotations

import math

import numpy as np

from rbjax.planning.maps.footprint import Footprint
from rbjax.planning.maps.occupancy import DistanceField
from rbjax.planning.paths.path import moved
from rbjax.planning.search.controls import MotionTable


class SweptMap:
    """A map's distances, and what a footprint sweeps by each motion."""

    def __init__(self, distances: DistanceField, table: MotionTable):
        self.values = np.asarray(distances.values)
        self.h, self.origin = float(distances.resolution), np.asarray(distances.origin, float)
        self.controls = len(table.turns)
        motions = len(table.headings) * self.controls
        self.discs = table.discs.reshape(2, motions, -1)
        self.radii = table.radii.reshape(motions, -1)
        far = np.hypot(*self.discs) + self.radii
        # `below` is less than the distance by a diagonal at most
        self.safe = far.max() + self.h * math.sqrt(2) * (1 + 1e-9)

    def below(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """`DistanceField.below`, where that is positive."""
        u = (x - self.origin[0]) * (1 / self.h) + 0.5
        v = (y - self.origin[1]) * (1 / self.h) + 0.5
        nx, ny = self.values.shape
        i = np.minimum(np.maximum(np.rint(u), 0), nx - 1)
        j = np.minimum(np.maximum(np.rint(v), 0), ny - 1)
        u -= i
        v -= j
        return self.values.ravel()[(i * ny + j).astype(np.intp)] - self.h * np.sqrt(u * u + v * v)

    def free(self, x: np.ndarray, y: np.ndarray, k: np.ndarray, control: np.ndarray) -> np.ndarray:
        """Whether motions from places (n,) m with the heading's number k (n,) are free."""
        free = self.below(x, y) > self.safe
        test = np.flatnonzero(~free)
        motion = k[test] * self.controls + control[test]
        a, b = x[test, None] + self.discs[0][motion], y[test, None] + self.discs[1][motion]
        free[test] = (self.below(a, b) > self.radii[motion]).all(1)
        return free

    def free_chains(
        self, starts: np.ndarray, steps: np.ndarray, footprint: Footprint
    ) -> np.ndarray:
        """Whether chains of steps (m, n, 3) from poses (m, 3) are free, as `clear_along` says."""
        centers, radii = np.asarray(footprint.centers, float), np.asarray(footprint.radii, float)
        way = np.hypot(steps[..., 0], steps[..., 1])[..., None] + np.abs(steps[..., 2:]) * np.hypot(
            *centers.T
        )
        parts = np.ceil(way.max(-1) / (self.h / 2)).astype(int)
        heads = starts[:, 2:] + np.cumsum(steps[..., 2], 1) - steps[..., 2]
        dx, dy = moved(heads, steps, np)
        x, y = (starts[:, i, None] + np.cumsum(d, 1) - d for i, d in ((0, dx), (1, dy)))
        # one row for each part of each step
        row = np.repeat(np.arange(parts.size), parts.ravel())
        number = np.arange(len(row)) - np.repeat(np.cumsum(parts) - parts.ravel(), parts.ravel())
        share = (number + 0.5) / parts.ravel()[row]
        some = share[:, None] * steps.reshape(-1, 3)[row]
        heading = heads.ravel()[row]
        sx, sy = moved(heading, some, np)
        heading = heading + some[:, 2]
        c, s = np.cos(heading)[:, None], np.sin(heading)[:, None]
        px = (x.ravel()[row] + sx)[:, None] + c * centers[:, 0] - s * centers[:, 1]
        py = (y.ravel()[row] + sy)[:, None] + s * centers[:, 0] + c * centers[:, 1]
        wide = radii + (way / np.maximum(2 * parts, 1)[..., None]).reshape(-1, len(radii))[row]
        hit = ~(self.below(px, py) > wide).all(1)
        free = np.ones(len(steps), bool)
        free[row[hit] // steps.shape[1]] = False
        return free
