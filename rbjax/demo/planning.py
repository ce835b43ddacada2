"""Planning: a car parks in a gap, and the shortest curve that knows no walls."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.axes import Axes

from rbjax.demo.report import Section
from rbjax.planning import Controls, Footprint, OccupancyGrid, clear, grid_dijkstra, reeds_shepp
from rbjax.plotting import BLUE, GREEN, INK, ORANGE, STYLE

AHEAD, BEHIND, WIDTH = 0.9, 0.3, 0.5  # of the axle, m
START, GOAL = (0.6, 2.6, 0.0), (3.25, 0.45, 0.0)
HEADINGS = 72
RADIUS, CELL = 0.8, 0.05  # m

_CODE = """\
grid = rb.planning.OccupancyGrid(walls, 0.05)
car = rb.planning.Controls.car(radius=0.8, turn=np.deg2rad(5.0), reversal=4)
shape = rb.planning.Footprint.rectangle(ahead=0.9, behind=0.3, width=0.5)
plan = rb.planning.grid_dijkstra(grid, shape, start, goal, car, headings=72)
curve = rb.planning.reeds_shepp(start, goal, 0.8)      # as if there were no walls"""


def planning(folder: Path, say: Callable[[str], None]) -> Section:
    """Run and draw."""
    say("a car parks in a gap")
    grid = street()
    car = Controls.car(RADIUS, np.deg2rad(360 / HEADINGS), reversal=4)
    shape = Footprint.rectangle(AHEAD, BEHIND, WIDTH)
    plan = grid_dijkstra(grid, shape, START, GOAL, car, headings=HEADINGS)
    curve = reeds_shepp(np.array(START), np.array(GOAL), RADIUS)
    field = grid.distance_field()
    rows = []
    drawn = {"grid_dijkstra": plan.poses, "reeds_shepp": np.asarray(curve.sample_poses(80))}
    for name, poses in drawn.items():
        length = np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()
        free = bool(np.asarray(clear(field, poses, shape)).all())
        rows.append((name, f"{length:.2f}", str(cusps(poses)), "yes" if free else "no"))
    with plt.rc_context(STYLE):
        figure, ax = plt.subplots(figsize=(8, 4.4), layout="constrained")
        draw_map(ax, grid)
        for pose in plan.poses[:: max(1, len(plan.poses) // 14)]:
            draw_car(ax, pose, BLUE, 0.25)
        draw_car(ax, START, GREEN)
        draw_car(ax, plan.poses[-1], BLUE)
        ax.plot(*plan.poses[:, :2].T, color=BLUE, label=f"grid_dijkstra, {plan.expanded:,} cells")
        ax.plot(*drawn["reeds_shepp"][:, :2].T, "--", color=ORANGE, label="reeds_shepp")
        ax.set(xlabel="x [m]", ylabel="y [m]", aspect="equal")
        ax.legend(loc="upper right")
        figure.savefig(folder / "planning.png")
        plt.close(figure)
    return Section(
        title="Planning",
        text=(
            "A car that cannot turn on the spot parks in a gap. The planner is the grid-based "
            "Dijkstra search of Modern Robotics, Algorithm 10.2: each control is integrated, a "
            "cell of position and heading is visited once, reversals have a price. The dashed "
            "curve is the shortest one of Reeds and Shepp, which knows no walls.",
        ),
        pictures=(("planning.png", "A car parks: its plan, and the curve without walls."),),
        columns=("path", "length [m]", "reversals", "free of walls"),
        rows=tuple(rows),
        code=_CODE,
    )


def street() -> OccupancyGrid:
    """A street of 6 x 3.5 m, with a gap between two parked cars and a post."""
    cell: Any = CELL
    n, m = round(6 / cell), round(3.5 / cell)
    x, y = (np.arange(k)[:, None] * cell + cell / 2 for k in (n, m))
    y = y.T
    parked = (y < 0.8) & ((x < 2.65) | (x > 4.6))
    post = np.hypot(x - 2.6, y - 2.3) < 0.25
    edge = (x < cell) | (x > 6 - cell) | (y < cell) | (y > 3.5 - cell)
    return OccupancyGrid(parked | post | edge, cell)


def cusps(poses: np.ndarray) -> int:
    """How often a path changes its direction of travel."""
    step = np.diff(poses[:, :2], axis=0)
    middle = (poses[1:, 2] + poses[:-1, 2]) / 2
    ahead = step[:, 0] * np.cos(middle) + step[:, 1] * np.sin(middle)
    ahead = ahead[np.abs(ahead) > 1e-9]
    return int((ahead[1:] * ahead[:-1] < 0).sum())


def draw_map(ax: Axes, grid: OccupancyGrid) -> None:
    nx, ny = grid.occupied.shape
    x0, y0 = np.asarray(grid.origin)
    h = float(grid.resolution)
    extent = (x0, x0 + nx * h, y0, y0 + ny * h)
    ax.imshow(np.asarray(grid.occupied).T, origin="lower", extent=extent, cmap="Greys", vmax=2)


def draw_car(ax: Axes, pose: np.ndarray | tuple, color: str, alpha: float = 1.0) -> None:
    x, y, heading = pose
    corners = np.array([[1, 1], [1, -1], [0, -1], [0, 1], [1, 1]])
    a = corners[:, 0] * (AHEAD + BEHIND) - BEHIND
    b = corners[:, 1] * WIDTH / 2
    c, s = np.cos(heading), np.sin(heading)
    ax.plot(x + c * a - s * b, y + s * a + c * b, color=color, alpha=alpha, lw=1.2)
    ax.plot([x], [y], ".", color=INK, alpha=alpha, ms=3)
