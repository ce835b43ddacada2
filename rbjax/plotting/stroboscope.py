"""A motion in one picture: its postures over one another."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes

from rbjax.model import Model
from rbjax.plotting.arguments import check_axis, configurations
from rbjax.plotting.camera import Camera
from rbjax.plotting.drawing import bare, draw_solids, shapes_of
from rbjax.plotting.film import poses
from rbjax.style import ORANGE


def strobe(
    ax: Axes,
    source: Any,
    model: Model,
    q: np.ndarray,
    *,
    camera: Camera | None = None,
    trace: str | None = None,
    color: str = ORANGE,
    shadow: bool = True,
    floating_base: bool = False,
) -> None:
    """Draw poses along a motion over one another, later ones stronger.

    Args:
        ax: the axis.
        source: what `rbjax.load` takes, for the shapes; None draws rods and ellipsoids.
        model: the robot.
        q: (T, nq) configurations, one drawn pose each.
        camera: line of sight.
        trace: a body whose origin leaves a line.
        color: the colour of that line.
        shadow: whether the last pose casts a shadow on the floor.
        floating_base: as in `rbjax.load`, for a source that is a URDF.

    Example:
        >>> import matplotlib.figure, numpy as np
        >>> import rbjax as rb
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> path = np.linspace(0.0, 1.0, 5)[:, None]
        >>> rb.plotting.strobe(ax, "pendulum", rb.load("pendulum"), path, shadow=False)
        >>> len(ax.patches)
        11
    """
    check_axis("strobe", ax)
    q = configurations("strobe", model, q)
    shapes = shapes_of(model, source, floating_base)
    R, p = poses(model, q)
    for i in range(len(q)):
        last = i == len(q) - 1
        alpha = 1.0 if last else 0.12 + 0.4 * (i / len(q)) ** 2
        draw_solids(ax, shapes, R[i], p[i], camera=camera, alpha=alpha, shadow=shadow and last,
                    world=last, zorder=2 + i)  # fmt: skip
    if trace is not None:
        path = p[:, model.body(trace)] @ (camera or Camera()).axes[:2].T
        ax.plot(*path.T, color=color, lw=1.2, zorder=2 + len(q))
    bare(ax)
