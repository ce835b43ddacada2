"""Top views of wheeled robots: poses of their parts, and forces on their wheels."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiling import compiled
from rbjax.model import State
from rbjax.optional import require
from rbjax.style import BLUE, GRID, INK, RED, is_dark
from rbjax.wheeled.kinematics.parameters import stack_lanes
from rbjax.wheeled.kinematics.planar import rotate
from rbjax.wheeled.models.robot_model import RobotModel, contacts

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.quiver import Quiver

SQUARE = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
THICK = 0.3  # half the thickness of a wheel, relative to its radius
FORCES, SLIDING = BLUE, RED


class Places(NamedTuple):
    """Poses of bodies and wheels on the ground."""

    origins: np.ndarray  # (..., n, 2), of bodies, m
    bodies: np.ndarray  # (..., n, 2), directions of bodies
    wheels: np.ndarray  # (..., m, 2), directions of wheels

    def at(self, k: int) -> Places:
        """Select the poses at one time."""
        return Places(*(x[k] for x in self))

    def points(self, body: int, p: Any) -> np.ndarray:
        """Convert points p (n, 2) of a body from its frame to the world's."""
        return self.origins[body] + vectors(p, self.bodies[body])


def vectors(p: Any, e: np.ndarray) -> np.ndarray:
    """Rotate vectors (n, 2) by the angle of the direction e."""
    x, y = np.moveaxis(np.asarray(p, float), -1, 0)
    return np.stack([x * e[0] - y * e[1], x * e[1] + y * e[0]], -1)


def places(model: RobotModel, q: Any) -> Places:
    """Compute the poses of bodies and wheels at coordinates q (..., nq)."""
    found = _places(model, jnp.asarray(q).reshape(-1, model.nq))
    lead = np.shape(q)[:-1]
    return Places(*(np.asarray(x, float).reshape(*lead, *x.shape[1:]) for x in found))


@compiled
def _places(model: RobotModel, q: jax.Array) -> tuple[jax.Array, ...]:
    def one(q: jax.Array) -> tuple[jax.Array, ...]:
        context = model.context(State(q, jnp.zeros(model.nv), jnp.zeros(model.nx)))
        n = context.n
        origins, bodies = zip(*context.bodies(), strict=True)
        wheels = [
            rotate(e, bodies[w.body]) for w, e in zip(n.wheels, context.shape.wheels, strict=True)
        ]
        tables = ([stack_lanes(x, q.dtype) for x in rows] for rows in (origins, bodies, wheels))
        return tuple(jnp.stack(x) for x in tables)

    return jax.vmap(one)(q)


def centers(robot: Any, at: Places) -> np.ndarray:
    """Compute the centres (m, 2) of the wheels."""
    out = []
    for wheel, e in zip(robot.wheels, at.wheels, strict=True):
        trail = float(wheel.trail) if wheel.kind == "caster" else 0.0
        out.append(at.points(wheel.body, wheel.position) - trail * e)
    return np.array(out)


def wheel_forces(
    model: RobotModel, state: State, ctrl: Any, at: Places
) -> tuple[np.ndarray, np.ndarray]:
    """Compute the forces (m, 2) on wheels, N, and their sliding velocities (m, 2), m/s, in world
    axes."""
    found = contacts(model, state, ctrl)
    forces, sliding = np.asarray(found.forces), np.asarray(found.sliding)
    turn = [at.bodies[wheel.body] for wheel in model.robot.wheels]
    return (
        np.array([vectors(f, e) for f, e in zip(forces, turn, strict=True)]),
        np.array([vectors(s, e) for s, e in zip(sliding, at.wheels, strict=True)]),
    )


def reach(robot: Any) -> float:
    """Compute the length of the longest arrow for a robot, m."""
    return 2 * max(float(np.hypot(*np.asarray(w.position))) for w in robot.wheels)


class Drawing:
    """Artists of a robot on an axis, which can be moved to other poses."""

    def __init__(self, ax: Axes, robot: Any, zorder: float = 2):
        self.robot = robot
        collections = require("top_view", "matplotlib.collections")
        PolyCollection, LineCollection = collections.PolyCollection, collections.LineCollection
        ink, pale = (GRID, INK) if is_dark(ax) else (INK, GRID)
        faces = [pale if w.kind == "caster" else ink for w in robot.wheels]
        self.bodies = PolyCollection([], facecolors="none", edgecolors=ink, lw=1, zorder=zorder)
        self.lines = LineCollection([], colors=ink, lw=0.8, zorder=zorder)
        self.wheels = PolyCollection([], facecolors=faces, edgecolors=ink, zorder=zorder + 1)
        self.rollers = LineCollection([], colors=pale, lw=1, zorder=zorder + 2)
        for collection in (self.bodies, self.lines, self.wheels, self.rollers):
            ax.add_collection(collection)

    def show(self, at: Places) -> np.ndarray:
        """Draw the robot at given poses. Return the corners (n, 2) of its bodies."""
        outlines, lines = [], []
        for k, body in enumerate(self.robot.bodies):
            box, nose = _outline(self.robot, k)
            outlines.append(at.points(k, box))
            if k == 0:
                lines.append(at.points(0, nose))
            else:
                joint = at.points(body.ahead, body.hitch)
                lines.append(np.stack([at.origins[body.ahead], joint, at.origins[k]]))
        wheels, rollers = [], []
        for wheel, center, e in zip(
            self.robot.wheels, centers(self.robot, at), at.wheels, strict=True
        ):
            r = float(wheel.radius)
            wheels.append(center + vectors(SQUARE * r * [1.0, THICK], e))
            if wheel.kind == "rollers":
                angle = float(wheel.roller)
                axis = vectors([np.cos(angle), np.sin(angle)], e)
                rollers.append(np.stack([center - 0.5 * r * axis, center + 0.5 * r * axis]))
        self.bodies.set_verts(outlines)
        self.lines.set_segments(lines)
        self.wheels.set_verts(wheels)
        self.rollers.set_segments(rollers)
        return np.concatenate(outlines)


def _outline(robot: Any, k: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute a box around the wheels of a body, and a mark of its front."""
    wheels = [w for w in robot.wheels if w.body == k]
    at = np.array([np.asarray(w.position) for w in wheels]).reshape(-1, 2)
    at = at if len(at) else np.zeros((1, 2))
    margin = max((float(w.radius) for w in wheels), default=0.1)
    low, high = at.min(0) - margin, at.max(0) + margin
    box = np.array([[high[0], high[1]], [high[0], low[1]], [low[0], low[1]], [low[0], high[1]]])
    back = high[0] - 0.5 * margin
    return box, np.array([[back, high[1]], [high[0], 0.5 * (low[1] + high[1])], [back, low[1]]])


def quiver(ax: Axes, at: Any, arrows: Any, color: str, zorder: float = 5) -> Quiver:
    """Draw arrows (n, 2), in the unit of the axis, at points (n, 2)."""
    at, arrows = np.reshape(at, (-1, 2)), np.reshape(arrows, (-1, 2))
    return ax.quiver(
        *at.T, *arrows.T, angles="xy", scale_units="xy", scale=1, color=color, width=0.006,
        zorder=zorder,
    )  # fmt: skip
