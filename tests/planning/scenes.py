"""Maps for planners, and oracles that share no code with them."""

import math

import numpy as np

from rbjax.planning import OccupancyGrid, Path

H = 0.1


def room(width: float, height: float, *boxes) -> OccupancyGrid:
    """A map in m with boxes (x0, y0, x1, y1) in m."""
    cells = np.zeros((round(width / H), round(height / H)), bool)
    for x0, y0, x1, y1 in boxes:
        i, j, k, l = (round(x / H) for x in (x0, y0, x1, y1))
        cells[i:k, j:l] = True
    return OccupancyGrid(cells, H)


def driven(path: Path, parts: int = 25) -> np.ndarray:
    """Poses along a path by small steps of the midpoint rule; the rule is exact for headings."""
    out = [np.asarray(path.start, float)]
    for a, b, turn in np.asarray(path.steps, float) / parts:
        for _ in range(parts):
            x, y, heading = out[-1]
            half = heading + turn / 2
            c, s = math.cos(half), math.sin(half)
            out.append(np.array([x + c * a - s * b, y + s * a + c * b, heading + turn]))
    return np.array(out)


def rectangle_hits(grid: OccupancyGrid, poses: np.ndarray, ahead, behind, width) -> bool:
    """Whether points of a rectangle, a third of a cell apart, are in an obstacle or off the map."""
    n = [math.ceil(3 * size / float(grid.resolution)) + 1 for size in (ahead + behind, width)]
    x, y = np.meshgrid(np.linspace(-behind, ahead, n[0]), np.linspace(-width, width, n[1]) / 2)
    c, s = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    px = poses[:, :1] + c * x.ravel() - s * y.ravel()
    py = poses[:, 1:2] + s * x.ravel() + c * y.ravel()
    i = np.floor((px - float(grid.origin[0])) / float(grid.resolution)).astype(int)
    j = np.floor((py - float(grid.origin[1])) / float(grid.resolution)).astype(int)
    nx, ny = grid.occupied.shape
    off = (i < 0) | (j < 0) | (i >= nx) | (j >= ny)
    return bool((off | np.asarray(grid.occupied)[i.clip(0, nx - 1), j.clip(0, ny - 1)]).any())


def bends(path: Path) -> float:
    """The largest curvature of the steps; steps that go sideways or turn on the spot are none."""
    a, b, turn = np.asarray(path.steps, float).T
    assert (b == 0).all() and (np.abs(a[np.abs(turn) > 0]) > 0).all()
    return float((np.abs(turn[a != 0]) / np.abs(a[a != 0])).max(initial=0.0))
