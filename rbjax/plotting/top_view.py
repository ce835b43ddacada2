"""Wheeled robots from above: bodies, wheels, the path, and the forces on wheels."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon

from rbjax.errors import InputError
from rbjax.model import State
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting.style import BLUE, GRID, INK, ORANGE
from rbjax.wheeled.contacts import contacts
from rbjax.wheeled.fidelity import Fidelity


def top_view(
    ax: Axes, vehicle: Fidelity, path: Trajectory, *, robots: int = 5, controls: Any = None
) -> None:
    """A motion from above: the way of the chassis' origin, and the robot at some of its times.

    Args:
        ax: an axis.
        vehicle: `rbjax.wheeled.at(robot, fidelity)`.
        path: of one vehicle, as `rbjax.wheeled.rollout` gives it.
        robots: at how many times the robot is drawn, evenly along the saved states.
        controls: (nu,), to draw the forces on wheels too, at a fidelity that has them; the longest
            is as long as the robot.

    Raises:
        InputError: a batch of motions.

    Example:
        >>> import matplotlib.figure, jax.numpy as jnp
        >>> from rbjax import wheeled
        >>> from rbjax.plotting import top_view
        >>> car = wheeled.at(wheeled.kinds()["car"].make(), "kinematical")
        >>> path = wheeled.rollout(car, wheeled.start(car), jnp.full((8, 2), 0.2), 0.1)
        >>> top_view(matplotlib.figure.Figure().subplots(), car, path)
    """
    if path.q.ndim != 2:
        raise InputError(
            f"top_view: path.q has shape {path.q.shape}, expected (T, nq): one motion"
        )
    q = np.asarray(path.q)
    ax.plot(q[:, 0], q[:, 1], color=ORANGE, lw=1.2, zorder=1)
    shown = np.unique(np.linspace(0, len(q) - 1, max(1, robots)).round().astype(int))
    arrows = []
    for k in shown:
        arrows += _robot(ax, vehicle, path.state(int(k)), controls)
    if arrows:
        at, force = (np.array(x) for x in zip(*arrows, strict=True))
        largest = np.hypot(*force.T).max()
        reach = max(float(np.hypot(*np.asarray(w.position))) for w in vehicle.robot.wheels)
        ax.quiver(
            *at.T, *(force * (2 * reach / max(largest, 1e-12))).T, angles="xy", scale_units="xy",
            scale=1, color=BLUE, width=0.006, zorder=4,
        )  # fmt: skip
    ax.set_aspect("equal")
    ax.set(xlabel="x [m]", ylabel="y [m]")


def _robot(ax: Axes, vehicle: Fidelity, state: State, controls: Any) -> list:
    """Draws bodies and wheels. Returns places and forces of wheels."""
    robot = vehicle.robot
    _, now = vehicle.instant(state)
    shape = now.shape
    frames: list[tuple[np.ndarray, np.ndarray]] = []
    for k, body in enumerate(robot.bodies):
        if body.ahead is None:
            heading = float(state.q[2])
            origin = np.asarray(state.q[:2], float)
        else:
            at, turn = frames[body.ahead]
            c, s = (float(x) for x in shape.trailers[k - 1])
            heading = np.arctan2(turn[1, 0], turn[0, 0]) + np.arctan2(s, c)
            bar = float(body.drawbar) * np.array([np.cos(heading), np.sin(heading)])
            origin = at + turn @ np.asarray(body.hitch) - bar
            joint = np.stack([at, at + turn @ np.asarray(body.hitch), origin])
            ax.plot(*joint.T, color=INK, lw=1, zorder=2)
        c, s = np.cos(heading), np.sin(heading)
        turn = np.array([[c, -s], [s, c]])
        frames.append((origin, turn))
        _outline(ax, robot, k, origin, turn)
    found = None if controls is None else contacts(vehicle, state, controls)
    arrows = []
    for i, wheel in enumerate(robot.wheels):
        origin, turn = frames[wheel.body]
        e = np.array([float(x) for x in shape.wheels[i]])
        place = np.asarray(wheel.position, float)
        if wheel.kind == "caster":
            place = place - float(wheel.trail) * e
        r = float(wheel.radius)
        across = np.array([-e[1], e[0]])
        corners = [place + a * r * e + b * 0.3 * r * across for a, b in _SIDES]
        face = GRID if wheel.kind == "caster" else INK
        ax.add_patch(Polygon([origin + turn @ c for c in corners], fc=face, ec=INK, zorder=3))
        if wheel.kind == "rollers":
            angle = float(wheel.roller)
            axis = np.cos(angle) * e + np.sin(angle) * across
            ends = [origin + turn @ (place + a * 0.5 * r * axis) for a in (-1, 1)]
            ax.plot(*np.transpose(ends), color=GRID, lw=1, zorder=4)
        if found is not None:
            arrows.append((origin + turn @ place, turn @ np.asarray(found.forces[i])))
    return arrows


_SIDES = ((1, 1), (1, -1), (-1, -1), (-1, 1))


def _outline(ax: Axes, robot: Any, k: int, origin: np.ndarray, turn: np.ndarray) -> None:
    """A box around the wheels and the coupling of a body, and a mark where it is ahead."""
    wheels = [w for w in robot.wheels if w.body == k]
    places = np.array([np.asarray(w.position) for w in wheels])
    margin = max(float(w.radius) for w in wheels)
    low, high = places.min(0) - margin, places.max(0) + margin
    corners = [[high[0], high[1]], [high[0], low[1]], [low[0], low[1]], [low[0], high[1]]]
    ax.add_patch(
        Polygon([origin + turn @ np.array(c) for c in corners], fc="none", ec=INK, lw=1, zorder=2)
    )
    nose = np.array([[high[0], 0.5 * (low[1] + high[1])], [high[0] - 0.5 * margin, high[1]],
                     [high[0] - 0.5 * margin, low[1]]])  # fmt: skip
    if k == 0:
        ax.plot(*(origin + nose[[1, 0, 2]] @ turn.T).T, color=INK, lw=0.8, zorder=2)
