"""Pictures of a motion: poses at several times on one axis."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from rbjax.arguments import real_number
from rbjax.contact import ContactForces
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.optional import require
from rbjax.plotting.arguments import configurations
from rbjax.plotting.contact_arrows import strokes, with_arrows
from rbjax.plotting.drawing import GROUNDS, draw_solids, shapes_of
from rbjax.plotting.film import Camera, film, poses
from rbjax.style import ORANGE, RED, axes_of, is_dark

if TYPE_CHECKING:
    from matplotlib.axes import Axes

#: margin of the ground of `strobe`, relative to the height of the robot
_AROUND = 0.6


def bare(*, ax: Axes, margin: float = 0.05) -> None:
    """Fit an axis to its polygons and lines, with equal scales, and hide frame and ticks.

    Args:
        ax: the axis.
        margin: on each side, as a fraction of the larger extent.

    Raises:
        InputError: not an axis of matplotlib, or one without polygons and lines.

    Example:
        >>> import matplotlib.figure
        >>> from rbjax.plotting import bare
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> _ = ax.fill([0, 1, 1], [0, 0, 1])
        >>> bare(ax=ax)
        >>> ax.get_xlim()
        (np.float64(-0.05), np.float64(1.05))
    """
    Polygon = require("bare", "matplotlib.patches").Polygon
    ax = axes_of("bare", ax)
    real_number("bare", "margin", margin, least=0.0)
    parts = [patch.get_xy() for patch in ax.patches if isinstance(patch, Polygon)]
    parts += [np.asarray(line.get_xydata()) for line in ax.lines]
    if not parts:
        raise InputError("bare: the axis has no polygon and no line, expected at least one")
    points = np.concatenate(parts)
    low, high = points.min(0), points.max(0)
    pad = margin * (high - low).max()
    ax.set(xlim=(low[0] - pad, high[0] + pad), ylim=(low[1] - pad, high[1] + pad), aspect="equal")
    ax.axis("off")


def strobe(
    model: Model,
    q: Any,
    *,
    ax: Axes | None = None,
    source: Any = None,
    camera: Camera | None = None,
    trace: str | None = None,
    color: str = ORANGE,
    shadow: bool = True,
    floating_base: bool = False,
    ground: bool = False,
    contacts: ContactForces | None = None,
) -> Axes:
    """Draw poses along a motion in one picture, with increasing opacity.

    Args:
        model: the robot.
        q: (T, nq), the configurations to draw; or states, such as a short `Trajectory`.
        ax: the axis to draw on; None makes a figure.
        source: an argument of `rbjax.load`, for the shapes; None draws rods and ellipsoids.
        camera: the line of sight.
        trace: a body whose origin leaves a line.
        color: the colour of that line.
        shadow: whether the last pose casts a shadow on the floor.
        floating_base: as in `rbjax.load`, for a source that is a URDF.
        ground: whether to draw the plane z = 0 under the poses.
        contacts: contact forces of the last pose to draw as arrows, as in `draw`.

    Returns:
        The axis.

    Raises:
        InputError: q has another shape or is not finite.

    Example:
        >>> import matplotlib.figure, numpy as np
        >>> import rbjax as rb
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> path = np.linspace(0.0, 1.0, 5)[:, None]
        >>> model = rb.load("pendulum")
        >>> len(rb.plotting.strobe(model, path, ax=ax, source="pendulum", shadow=False).patches)
        11
    """
    q = configurations("strobe", model, q)
    ax = axes_of("strobe", ax)
    shapes = shapes_of(model, source, floating_base)
    R, p = poses(model, q)
    for i in range(len(q)):
        last = i == len(q) - 1
        alpha = 1.0 if last else 0.12 + 0.4 * (i / len(q)) ** 2
        draw_solids(shapes, R[i], p[i], ax=ax, camera=camera, alpha=alpha, shadow=shadow and last,
                    world=last, zorder=2 + i)  # fmt: skip
    axes = (camera or Camera()).axes[:2]
    if trace is not None:
        path = p[:, model.body(trace)] @ axes.T
        ax.plot(*path.T, color=color, lw=1.2, zorder=2 + len(q))
    if ground:
        low, high = p[..., :2].min((0, 1)), p[..., :2].max((0, 1))
        x, y = np.array([low, high]).T + _AROUND * np.ptp(p[-1, :, 2]) * np.array([-1, 1])
        corners = [[x[0], y[0], 0], [x[1], y[0], 0], [x[1], y[1], 0], [x[0], y[1], 0]]
        ax.fill(
            *(np.array(corners) @ axes.T).T, color=GROUNDS[is_dark(ax.figure)][0], lw=0, zorder=0
        )
    if contacts is not None:
        shown = film(model, np.zeros(1), q[None, -1:], shapes, camera=camera)
        shown = with_arrows("strobe", shown, model, contacts)
        assert shown.arrows is not None
        for line in strokes(shown.arrows[0], axes, 0.04 * shown.size.max()):
            ax.plot(*line.T, color=RED, lw=1.8, zorder=3 + len(q))
    bare(ax=ax)
    return ax
