"""Pictures of robots with matplotlib, without OpenGL or a window: postures, motions, charts.

`draw` shows one posture, and `strobe` a motion in one picture. `animate` writes a GIF, an MP4 or an
HTML page, and `animate_policy` does so for a policy in its environment. All draw a model from its
parameters (rods and ellipsoids of inertia) or from its file (geoms), with beams as swept tubes and
modal bodies as lines between their frames. `top_view` and `animate_top_view` show wheeled robots
from above.

All functions take the data first, and `ax=` by keyword: the axis to draw on, None for a new figure.
Where they take coordinates q they also take states.
"""

from rbjax.plotting.animation import animate
from rbjax.plotting.charts import time_plot
from rbjax.plotting.drawing import draw, draw_solids
from rbjax.plotting.film import Camera, poses
from rbjax.plotting.policies import RecordedEpisodes, animate_policy, record_policy
from rbjax.plotting.solid_shapes import Solid, solids
from rbjax.plotting.stick_figure import skeleton
from rbjax.plotting.stroboscope import bare, strobe
from rbjax.plotting.top_views import animate_top_view, top_view
from rbjax.style import (
    BLUE,
    GREEN,
    GRID,
    INK,
    ORANGE,
    PALETTE,
    PAPER,
    PURPLE,
    RED,
    STYLE,
    TEAL,
)

__all__ = [
    "BLUE",
    "GREEN",
    "GRID",
    "INK",
    "ORANGE",
    "PALETTE",
    "PAPER",
    "PURPLE",
    "RED",
    "STYLE",
    "TEAL",
    "Camera",
    "RecordedEpisodes",
    "Solid",
    "animate",
    "animate_policy",
    "animate_top_view",
    "bare",
    "draw",
    "draw_solids",
    "poses",
    "record_policy",
    "skeleton",
    "solids",
    "strobe",
    "time_plot",
    "top_view",
]

__dir__ = __all__.copy
