"""What moving pictures share: the times of their frames, the canvas, the clock."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from rbjax.errors import InputError

_DPI = 100


def check_positive(where: str, **given: float) -> None:
    """Refuse rates and counts that are not above zero."""
    for name, value in given.items():
        if not value > 0:
            raise InputError(f"{where}: {name} is {value}, expected more than 0")


def schedule(
    where: str, ts: np.ndarray, q: np.ndarray, fps: float, speed: float
) -> tuple[int, np.ndarray]:
    """How many states are drawn, and times (F,) s of frames, one each 1/fps s of playing.

    ts (T,), q (..., T, nq). What comes after a state that is not finite is left out, with a
    warning.
    """
    others = tuple(k for k in range(q.ndim) if k != q.ndim - 2)
    whole = np.isfinite(q).all(others) & np.isfinite(ts)
    kept = len(ts) if whole.all() else int(whole.argmin())
    if not kept:
        raise InputError(f"{where}: the first state is not finite, expected numbers to draw")
    if kept < len(ts):
        warnings.warn(
            f"the motion is not finite after t = {ts[kept - 1]:.4g} s; what follows is left out",
            stacklevel=4,
        )
    count = 1 + int(np.floor((ts[kept - 1] - ts[0]) * fps / speed + 1e-6))
    return kept, ts[0] + np.arange(count) * speed / fps


def canvas_of(size: tuple[int, int]) -> tuple[FigureCanvasAgg, Figure]:
    """A canvas of so many pixels, and its figure."""
    figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI)
    return FigureCanvasAgg(figure), figure


def picture(canvas: Any) -> np.ndarray:
    """What is on a canvas (height, width, 3)."""
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def clock(t: float, speed: float) -> str:
    """The text that says the time."""
    rate = "" if speed == 1 else f"   {speed:g} x real time"
    return f"t = {t:.2f} s{rate}"
