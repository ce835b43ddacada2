"""Small pictures as SVG text, for displays in a notebook: curves, cells and polygons.

Frames and labels have the colour of the text, so that they are legible on light and dark pages.
"""

from __future__ import annotations

import html
from collections.abc import Sequence

import numpy as np

from rbjax.style import PALETTE

#: the size of a picture in pixels, and the margin for its labels
SIZE, MARGIN = (360, 150), 16
#: the largest number of points of a curve and of cells along an axis
POINTS, CELLS = 200, 120


def curves(t: np.ndarray, y: np.ndarray, label: str) -> str:
    """Draw the columns of y (T, n) over the times t (T,), with the ranges of both axes.

    Values that are not finite leave gaps.
    """
    at = np.unique(np.linspace(0, len(t) - 1, min(len(t), POINTS)).astype(int))
    t, y = np.asarray(t, float)[at], np.asarray(y, float)[at]
    finite: np.ndarray = np.isfinite(y)
    low, high = (y[finite].min(), y[finite].max()) if finite.any() else (0.0, 0.0)
    width, height = SIZE
    x = width * (t - t[0]) / (float(t[-1] - t[0]) or 1.0)
    up = MARGIN + (height - 2 * MARGIN) * (1 - (y - low) / (float(high - low) or 1.0))
    lines = []
    for k, color in zip(range(y.shape[1]), _colors(y.shape[1]), strict=True):
        known = np.flatnonzero(finite[:, k])
        for run in np.split(known, np.flatnonzero(np.diff(known) > 1) + 1):
            points = " ".join(f"{x[i]:.1f},{up[i, k]:.1f}" for i in run)
            lines.append(f'<polyline points="{points}" fill="none" stroke="{color}"/>')
    marks = [
        _text(4, 11, f"{label}, up to {high:.4g}"), _text(4, height - 4, f"{low:.4g}"),
        _text(width - 4, height - 4, f"{t[0]:.4g} to {t[-1]:.4g} s", "end"),
    ]  # fmt: skip
    frame = f'<rect width="{width}" height="{height}" fill="none" stroke="currentColor" '
    return _svg(SIZE, [*lines, f'{frame}opacity="0.3"/>', *marks])


def cells(filled: np.ndarray) -> str:
    """Draw the filled cells of a table (nx, ny), with x to the right and y upwards.

    A large table is coarse: a cell of the picture is filled if one of its cells is.
    """
    filled = np.asarray(filled, bool)
    step = max(1, -(-max(filled.shape) // CELLS))
    pad = [(0, -n % step) for n in filled.shape]
    coarse = np.pad(filled, pad).reshape(*(v for n in filled.shape for v in (-(-n // step), step)))
    found = np.asarray(coarse.any((1, 3)))
    nx, ny = found.shape
    scale = 240 / max(nx, ny, 1)
    path = []
    for j in range(ny):
        ends = np.flatnonzero(np.diff(found[:, j].astype(int), prepend=0, append=0))
        for i, end in ends.reshape(-1, 2):
            path.append(f"M{i},{ny - 1 - j}h{end - i}v1h{i - end}z")
    size = (round(scale * nx), round(scale * ny))
    frame = f'<rect width="{nx}" height="{ny}" fill="currentColor" opacity="0.1"/>'
    shape = f'<path d="{"".join(path)}" fill="currentColor"/>'
    return _svg(size, [f'<g transform="scale({scale:.4g})">{frame}{shape}</g>'])


def polygons(outlines: Sequence[np.ndarray], filled: Sequence[bool]) -> str:
    """Draw closed outlines (n, 2) to scale, with x to the right and y upwards."""
    points = np.concatenate([np.asarray(x, float) for x in outlines])
    low, high = points.min(0), points.max(0)
    scale = 200 / (float((high - low).max()) or 1.0)
    shapes = []
    for outline, full in zip(outlines, filled, strict=True):
        at = (np.asarray(outline, float) - low) * scale + 4
        text = " ".join(f"{x:.1f},{(high - low)[1] * scale + 8 - y:.1f}" for x, y in at)
        fill = "currentColor" if full else "none"
        shapes.append(f'<polygon points="{text}" fill="{fill}" stroke="currentColor"/>')
    width, height = np.ceil((high - low) * scale).astype(int) + 8
    return _svg((int(width), int(height)), shapes)


def _colors(count: int) -> list[str]:
    return [PALETTE[k % len(PALETTE)] for k in range(count)]


def _text(x: float, y: float, words: str, anchor: str = "start") -> str:
    return (
        f'<text x="{x}" y="{y}" font-size="11" fill="currentColor" text-anchor="{anchor}">'
        f"{html.escape(words)}</text>"
    )


def _svg(size: tuple[int, int], parts: Sequence[str]) -> str:
    width, height = size
    view = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {view}>{"".join(parts)}</svg>'
