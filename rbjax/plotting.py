"""Pictures of robots with matplotlib alone: no GL, no window.

Every geom of the MuJoCo file is a convex solid. Points of its surface, moved by our own forward
kinematics, are projected along the line of sight; their convex hull is filled in the geom's
colour, far ones first, over a shadow on the floor. `strobe` overlays a motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import mujoco
import numpy as np
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from scipy.spatial import ConvexHull, QhullError

from rbjax.dynamics import forward_kinematics
from rbjax.loading import compile_model
from rbjax.model import Model

Array = np.ndarray

INK, PAPER, GRID = "#22303c", "#ffffff", "#d9dee3"
BLUE, ORANGE, GREEN, RED, PURPLE, TEAL = (
    "#2a6fb0", "#e8832a", "#3d9a5f", "#c8433f", "#7a5ba8", "#2a9aa0",
)  # fmt: skip
PALETTE = (BLUE, ORANGE, GREEN, PURPLE, RED, TEAL)

STYLE: Any = {
    "figure.facecolor": PAPER, "axes.facecolor": PAPER, "axes.edgecolor": INK,
    "axes.labelcolor": INK, "axes.titlesize": 11, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False,
    "axes.grid": True, "grid.color": GRID, "grid.linewidth": 0.7, "axes.axisbelow": True,
    "text.color": INK, "xtick.color": INK, "ytick.color": INK, "font.size": 10,
    "legend.frameon": False, "legend.fontsize": 9, "savefig.dpi": 130,
    "axes.prop_cycle": cycler(color=PALETTE),
}  # fmt: skip


@dataclass(frozen=True)
class Solid:
    """A geom: surface points (n, 3) in its body's frame, body (-1: world), colour, opacity."""

    points: Array
    body: int
    color: tuple[float, float, float]
    alpha: float


@dataclass(frozen=True)
class Camera:
    """A line of sight by azimuth and elevation in degrees, orthographic."""

    azimuth: float = -60.0
    elevation: float = 12.0

    @property
    def axes(self) -> Array:
        """Rows: right, up, towards the eye."""
        a, e = np.radians(self.azimuth), np.radians(self.elevation)
        eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.stack([right, np.cross(eye, right), eye])


def solids(source: Any) -> list[Solid]:
    """The visible geoms of a robot file, floors left out.

    Example:
        >>> from rbjax.plotting import solids
        >>> len(solids("pendulum"))
        3
    """
    m = compile_model(source)
    out = []
    for i in range(m.ngeom):
        surface = _surface(m, i)
        if surface is None or m.geom_group[i] > 2:
            continue
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, m.geom_quat[i])
        rgba = m.geom_rgba[i] if m.geom_matid[i] < 0 else m.mat_rgba[m.geom_matid[i]]
        color = (float(rgba[0]), float(rgba[1]), float(rgba[2]))
        points = surface @ R.reshape(3, 3).T + m.geom_pos[i]
        if rgba[3] > 0:
            out.append(Solid(points, int(m.geom_bodyid[i]) - 1, color, float(rgba[3])))
    return out


def _surface(m: mujoco.MjModel, i: int) -> Array | None:
    """Points of a geom's surface in its own frame; None for planes and the like."""
    a, b, c = m.geom_size[i]
    kind, shape = mujoco.mjtGeom(m.geom_type[i]), mujoco.mjtGeom
    if kind == shape.mjGEOM_SPHERE:
        return a * _SPHERE
    if kind == shape.mjGEOM_ELLIPSOID:
        return _SPHERE * [a, b, c]
    if kind == shape.mjGEOM_CAPSULE:
        return np.concatenate([a * _SPHERE + [0, 0, b], a * _SPHERE - [0, 0, b]])
    if kind == shape.mjGEOM_CYLINDER:
        ring = np.stack([a * np.cos(_TURN), a * np.sin(_TURN), 0 * _TURN], -1)
        up = np.array([0, 0, b])
        return np.concatenate([ring + up, ring - up])
    if kind == shape.mjGEOM_BOX:
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return corners * [a, b, c]
    if kind == shape.mjGEOM_MESH:
        k = m.geom_dataid[i]
        return m.mesh_vert[m.mesh_vertadr[k] : m.mesh_vertadr[k] + m.mesh_vertnum[k]]
    return None


_TURN = np.linspace(0, 2 * np.pi, 25)
_SPHERE = np.array(
    [
        [np.cos(t) * np.sin(e), np.sin(t) * np.sin(e), np.cos(e)]
        for e in np.linspace(0, np.pi, 13)
        for t in _TURN
    ]
)


def poses(model: Model, q: Array) -> tuple[Array, Array]:
    """Rotations (T, nb, 3, 3) and positions (T, nb, 3) of the bodies along a motion q (T, nq)."""
    R, p = jax.jit(jax.vmap(forward_kinematics, (None, 0)))(model, q)
    return np.asarray(R), np.asarray(p)


def draw(
    ax: Axes,
    shapes: Sequence[Solid],
    R: Array,
    p: Array,
    *,
    camera: Camera | None = None,
    alpha: float = 1.0,
    shadow: bool = True,
    world: bool = True,
    zorder: float = 2.0,
) -> None:
    """One pose on an axis: R (nb, 3, 3), p (nb, 3)."""
    axes = (camera or Camera()).axes
    placed = []
    for s in shapes:
        if s.body < 0 and not world:
            continue
        points = s.points if s.body < 0 else s.points @ R[s.body].T + p[s.body]
        placed.append((float((points @ axes[2]).mean()), points, s))
    if shadow:
        for _, points, _s in placed:
            ground = (points * [1, 1, 0]) @ axes[:2].T
            _fill(ax, ground, color="#000000", alpha=0.06 * alpha, lw=0, zorder=zorder - 1)
    for depth, (_, points, s) in enumerate(sorted(placed, key=lambda item: item[0])):
        edge = tuple(0.62 * c for c in s.color)
        flat = points @ axes[:2].T
        style = {"facecolor": s.color, "edgecolor": edge, "lw": 0.7, "alpha": alpha * s.alpha}
        _fill(ax, flat, zorder=zorder + 1e-3 * depth, **style)


def _fill(ax: Axes, points: Array, **style: Any) -> None:
    try:
        hull = points[ConvexHull(points).vertices]
    except QhullError:  # seen edge on
        return
    ax.add_patch(Polygon(hull, closed=True, joinstyle="round", **style))


def bare(ax: Axes, margin: float = 0.05) -> None:
    """Fit the axis to what is drawn, in equal scales, without frame or ticks."""
    points = np.concatenate([patch.get_xy() for patch in ax.patches if isinstance(patch, Polygon)])
    points = np.concatenate([points, *(line.get_xydata() for line in ax.lines)])
    low, high = points.min(0), points.max(0)
    pad = margin * (high - low).max()
    ax.set(xlim=(low[0] - pad, high[0] + pad), ylim=(low[1] - pad, high[1] + pad), aspect="equal")
    ax.axis("off")


def strobe(
    ax: Axes,
    source: Any,
    model: Model,
    q: Array,
    *,
    camera: Camera | None = None,
    trace: str | None = None,
    color: str = ORANGE,
    shadow: bool = True,
) -> None:
    """Poses along a motion over one another, later ones stronger; `trace` draws a site's path.

    Args:
        ax: the axis.
        source: what `rbjax.load` takes, for the shapes.
        model: the robot.
        q: (T, nq) configurations, one drawn pose each.
        camera: line of sight.
        trace: a body whose origin leaves a line.
        color: of the line.
        shadow: whether the last pose throws one on the floor.
    """
    shapes = solids(source)
    R, p = poses(model, np.asarray(q))
    for i in range(len(q)):
        last = i == len(q) - 1
        alpha = 1.0 if last else 0.12 + 0.4 * (i / len(q)) ** 2
        draw(ax, shapes, R[i], p[i], camera=camera, alpha=alpha, shadow=shadow and last,
             world=last, zorder=2 + i)  # fmt: skip
    if trace is not None:
        path = p[:, model.body(trace)] @ (camera or Camera()).axes[:2].T
        ax.plot(*path.T, color=color, lw=1.2, zorder=2 + len(q))
    bare(ax)


def time_plot(axes: Sequence[Axes], ts: Array, q: Array, v: Array, names: Sequence[str]) -> None:
    """Configuration and velocity coordinates over time, on two axes."""
    for ax, x, label in ((axes[0], q, "q  [m, rad, -]"), (axes[1], v, "v  [m/s, rad/s]")):
        for i in range(x.shape[-1]):
            ax.plot(ts, x[:, i], lw=1.4, label=names[i] if i < len(names) else None)
        ax.set(xlabel="time [s]", ylabel=label)
