"""Top views of wheeled robots: a motion in one picture, or as an animation."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from rbjax.arguments import check_positive, file_path, instance, integer
from rbjax.errors import InputError
from rbjax.model import State
from rbjax.motion.trajectory import Trajectory
from rbjax.optional import require
from rbjax.plotting import movie_files
from rbjax.plotting.arguments import check_size
from rbjax.plotting.from_above import (
    FORCES,
    SLIDING,
    Drawing,
    Places,
    centers,
    places,
    quiver,
    reach,
    wheel_forces,
)
from rbjax.plotting.movie_files import canvas_of, clock, picture, schedule
from rbjax.style import GRID, INK, ORANGE, STYLE, axes_of
from rbjax.wheeled.models.robot_model import RobotModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def top_view(
    model: RobotModel,
    trajectory: Trajectory,
    *,
    ax: Axes | None = None,
    robots: int = 5,
    ctrl: Any = None,
    grid: Any = None,
) -> Axes:
    """Draw a motion from above: the path of the chassis' origin, and the robot at some times.

    Args:
        model: `rbjax.wheeled.at(robot, fidelity)`.
        trajectory: of one robot, from `rbjax.wheeled.rollout`; lengths in m.
        ax: the axis to draw on; None makes a figure.
        robots: the number of times at which the robot is drawn, evenly along the saved states.
        ctrl: (nu,), (T, nu) or a function (t, state) -> (nu,), to draw also the forces on
            wheels, at a fidelity that has them. The longest arrow is as long as the robot.
        grid: a map, an `rbjax.planning.OccupancyGrid`.

    Returns:
        The axis.

    Raises:
        InputError: a batch of motions; controls of another shape.

    Example:
        >>> import matplotlib.figure, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> from rbjax.plotting import top_view
        >>> car = wheeled.at(wheeled.kinds()["car"].make(), "reduced")
        >>> path = wheeled.rollout(car, wheeled.start(car), jnp.full((8, 2), 0.2), 0.1)
        >>> top_view(car, path, ax=matplotlib.figure.Figure().subplots()).get_xlabel()
        'x [m]'
    """
    robots = min(integer("top_view", "robots", robots, least=0), 10_000)
    _check("top_view", trajectory, ctrl, model)
    ax, path = axes_of("top_view", ax), trajectory
    q = np.asarray(path.q)
    _ground(ax, grid)
    ax.plot(q[:, 0], q[:, 1], color=ORANGE, lw=1.2, zorder=1)
    shown = np.unique(np.linspace(0, len(q) - 1, max(1, robots)).round().astype(int))
    at, forces = [], []
    for k in shown:
        here = places(model, q[k])
        ax.update_datalim(Drawing(ax, model.robot).show(here))
        if ctrl is not None:
            given = _given(ctrl, path.ts[k], path.state(int(k)), k)
            force, _ = wheel_forces(model, path.state(int(k)), given, here)
            at.append(centers(model.robot, here))
            forces.append(force)
    if forces:
        arrows = np.concatenate(forces)
        quiver(ax, np.concatenate(at), arrows * _scale(model, arrows), FORCES)
    ax.autoscale_view()
    ax.set_aspect("equal")
    ax.set(xlabel="x [m]", ylabel="y [m]")
    return ax


def animate_top_view(
    model: RobotModel,
    trajectory: Trajectory,
    path: str | Path,
    *,
    ctrl: Any = None,
    grid: Any = None,
    footprint: Any = None,
    fps: float = 25.0,
    speed: float = 1.0,
    title: str = "",
    size: tuple[int, int] = (800, 600),
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write an animation of a motion from above as a GIF or an MP4.

    It shows the robot, its wheels and its past path. With controls, it also shows the forces on
    wheels (blue) and their sliding velocities (red). The longest arrow of each is as long as the
    robot.

    Args:
        model: `rbjax.wheeled.at(robot, fidelity)`.
        trajectory: of one robot, from `rbjax.wheeled.rollout`; lengths in m, times in s.
        path: the file to write, .gif, or .mp4, which requires ffmpeg.
        ctrl: (nu,), (T, nu) or a function (t, state) -> (nu,), at a fidelity with forces on
            wheels: "slipping" or "constrained".
        grid: a map, an `rbjax.planning.OccupancyGrid`.
        footprint: an `rbjax.planning.Footprint` of the chassis.
        fps: frames per second of the animation.
        speed: seconds of motion per second of the animation.
        title: text at the top.
        size: width and height in pixels.
        progress: called with the number of frames done and their total; None displays a progress
            bar in a terminal.

    Returns:
        The path of the file.

    Raises:
        InputError: a batch of motions, another suffix, ffmpeg missing, controls of another shape.

    Example:
        >>> import pathlib, tempfile, jax.numpy as jnp
        >>> from rbjax import plotting, wheeled
        >>> car = wheeled.at(wheeled.kinds()["car"].make(), "reduced")
        >>> path = wheeled.rollout(car, wheeled.start(car), jnp.full((4, 2), 0.2), 0.1)
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "car.gif"
        >>> plotting.animate_top_view(car, path, file, size=(200, 150)).name
        'car.gif'
    """
    file = file_path("animate_top_view", path)
    movie_files.check("animate_top_view", file, (".gif", ".mp4"))
    _check("animate_top_view", trajectory, ctrl, model)
    check_positive("animate_top_view", fps=fps, speed=speed)
    check_size("animate_top_view", size)
    film = _Film(model, trajectory, ctrl, fps, speed)
    pictures = film.pictures(grid, footprint, title, speed, size)
    movie_files.write(file, pictures, len(film.ts), fps, progress)
    return file


class _Film:
    """The frames of a motion: coordinates, poses of parts, forces and sliding velocities."""

    def __init__(self, model: RobotModel, path: Trajectory, ctrl: Any, fps: float, speed: float):
        ts = np.asarray(path.ts, float)
        kept, self.ts = schedule("animate_top_view", ts, np.asarray(path.q), fps, speed)
        ts, count, self.model = ts[:kept], len(self.ts), model
        self.q, v, x = (_between(self.ts, ts, table) for table in (path.q, path.v, path.x))
        self.places = places(model, self.q)
        self.at = np.array([centers(model.robot, self.places.at(k)) for k in range(count)])
        self.forces = self.sliding = None
        if ctrl is not None:
            last = np.clip(np.searchsorted(ts, self.ts, side="right") - 1, 0, len(ts) - 1)
            found = []
            for k in range(count):
                state = State(self.q[k], v[k], None if x is None else x[k])
                given = _given(ctrl, self.ts[k], state, last[k])
                found.append(wheel_forces(model, state, given, self.places.at(k)))
            forces, sliding = (np.array(rows) for rows in zip(*found, strict=True))
            self.forces = forces * _scale(model, forces)
            self.sliding = sliding * _scale(model, sliding)

    def pictures(
        self, grid: Any, footprint: Any, title: str, speed: float, size: tuple[int, int]
    ) -> Iterator[np.ndarray]:
        canvas, figure = canvas_of(size)
        left, below = (min(0.3, 60 / pixels) for pixels in size)
        top = 0.98 - (min(0.2, 36 / size[1]) if title else 0.0)
        with require("animate_top_view", "matplotlib").rc_context(STYLE):
            ax = figure.add_axes((left, below, 0.96 - left, top - below))
        _ground(ax, grid)
        ax.set(xlabel="x [m]", ylabel="y [m]", title=title)
        ax.set_aspect("equal")
        margin = 0.75 * reach(self.model.robot)
        points = np.concatenate([self.at.reshape(-1, 2), self.q[:, :2]])
        low, high = points.min(0) - margin, points.max(0) + margin
        ax.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
        (way,) = ax.plot([], [], color=ORANGE, lw=1.2, zorder=1)
        robot = Drawing(ax, self.model.robot)
        discs = None if footprint is None else _Discs(ax, footprint)
        arrows = [
            (quiver(ax, self.at[0], table[0], color), table)
            for table, color in ((self.forces, FORCES), (self.sliding, SLIDING))
            if table is not None
        ]
        label = ax.text(0.02, 0.02, "", transform=ax.transAxes, family="monospace", color=INK)
        for k, t in enumerate(self.ts):
            here = self.places.at(k)
            way.set_data(*self.q[: k + 1, :2].T)
            robot.show(here)
            if discs is not None:
                discs.show(here)
            for shown, table in arrows:
                shown.set_offsets(self.at[k])
                shown.set_UVC(*table[k].T)
            label.set_text(clock(t, speed))
            yield picture(canvas)


class _Discs:
    """The discs of a footprint as artists on an axis."""

    def __init__(self, ax: Axes, footprint: Any):
        self.centers = np.asarray(footprint.centers, float)
        wide = 2 * np.asarray(footprint.radii, float)
        collections = require("top_view", "matplotlib.collections")
        self.shown = collections.EllipseCollection(
            wide, wide, np.zeros(len(wide)), units="xy", offsets=self.centers,
            offset_transform=ax.transData, fc=GRID, ec="none", alpha=0.5, zorder=1.5,
        )  # fmt: skip
        ax.add_collection(self.shown)

    def show(self, at: Places) -> None:
        self.shown.set_offsets(at.points(0, self.centers))


def _ground(ax: Axes, grid: Any) -> None:
    """Draw the occupied cells of a map."""
    if grid is None:
        return
    (nx, ny), h = grid.occupied.shape, float(grid.resolution)
    x, y = (float(a) for a in grid.origin)
    extent = (x, x + nx * h, y, y + ny * h)
    occupied = np.asarray(grid.occupied, bool).T
    cells = np.ma.masked_array(np.full(occupied.shape, 0.5), ~occupied)  # free cells are clear
    ax.imshow(cells, origin="lower", extent=extent, cmap="Greys", vmin=0, vmax=1, zorder=0.7)


def _scale(model: RobotModel, arrows: np.ndarray) -> float:
    """Compute the factor that scales the longest arrow to the length of the robot."""
    longest = float(np.hypot(arrows[..., 0], arrows[..., 1]).max())
    return reach(model.robot) / longest if longest > 1e-9 else 0.0


def _between(t: np.ndarray, ts: np.ndarray, table: Any) -> Any:
    """Interpolate a table (T, n) at other times."""
    if table is None:
        return None
    columns = [np.interp(t, ts, column) for column in np.asarray(table, float)[: len(ts)].T]
    return np.stack(columns, -1) if columns else np.zeros((len(t), 0))


def _given(ctrl: Any, t: Any, state: State, k: int) -> Any:
    """Return the controls (nu,) at time t, which is the k-th time of the motion."""
    if callable(ctrl):
        return ctrl(t, jax.tree.map(jax.numpy.asarray, state))
    return ctrl if np.ndim(ctrl) == 1 else ctrl[k]


def _check(where: str, path: Trajectory, ctrl: Any, model: RobotModel) -> None:
    instance(where, "model", model, RobotModel, "wheeled.at(...)")
    instance(where, "trajectory", path, Trajectory, "a Trajectory")
    if path.q.ndim != 2:
        raise InputError(
            f"{where}: trajectory.q has shape {path.q.shape}, expected (T, nq): one motion"
        )
    due = [(model.nu,), (len(path.q), model.nu)]
    if ctrl is not None and not callable(ctrl) and np.shape(ctrl) not in due:
        raise InputError(
            f"{where}: ctrl has shape {np.shape(ctrl)}, expected {due[0]}, or {due[1]}, "
            "one row for each saved state, or a function (t, state)"
        )
