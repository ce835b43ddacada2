"""Frames of a motion in the style of `rbjax.plotting`, and animated WebP files."""

from __future__ import annotations

import dataclasses
import io
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image, ImageSequence

from rbjax.model import Model
from rbjax.plotting.drawing import Stage, shapes_of
from rbjax.plotting.film import Camera, film
from rbjax.plotting.movie_files import canvas_of, picture

FPS = 12.5
#: frames of a clip
COUNT = 48
#: s, the time of a frame after the first
TIMES = np.arange(COUNT) / FPS
#: the ground of a dark page of GitHub
DARK = (13, 17, 23)
#: CSS's hue-rotate(180deg)
HUE = np.array([[-0.574, 1.43, 0.144], [0.426, 0.43, 0.144], [0.426, 1.43, -0.856]])
#: qualities of WebP that are tried, from the best
QUALITIES = (85, 75, 65, 55, 45, 35, 25, 15)


def robot_frames(
    model: Model,
    q: np.ndarray,
    size: tuple[int, int],
    *,
    source: Any = None,
    camera: Camera | None = None,
    zoom: float = 1.0,
    shift: Sequence[float] = (0.0, 0.0, 0.0),
    **options: Any,
) -> Iterator[np.ndarray]:
    """Draw the frames (height, width, 3) of configurations q (F, nq) or (S, F, nq).

    zoom: enlarges the robot. shift: moves the middle of the picture, m. options: of
    `rbjax.plotting.film.film`.
    """
    q = q[None] if q.ndim == 2 else q
    shown = film(model, TIMES[: q.shape[1]], q, shapes_of(model, source), camera=camera, **options)
    shown = dataclasses.replace(
        shown, size=shown.size / zoom, centre=shown.centre + np.asarray(shift)
    )
    canvas, figure = canvas_of(size)
    stage = Stage(figure.add_axes((0, 0, 1, 1)), shown)
    for frame in range(q.shape[1]):
        stage.show(frame)
        yield picture(canvas).copy()


def encoded(frames: Sequence[np.ndarray], quality: int) -> bytes:
    """An animated WebP that repeats."""
    first, *others = (Image.fromarray(frame) for frame in frames)
    out = io.BytesIO()
    first.save(
        out, "WEBP", save_all=True, append_images=others, duration=round(1000 / FPS), loop=0,
        quality=quality, method=6,
    )  # fmt: skip
    return out.getvalue()


def save(frames: Sequence[np.ndarray], path: Path, most: int) -> None:
    """Write an animated WebP of at most `most` bytes, in the best quality that has them."""
    for quality in QUALITIES:
        data = encoded(frames, quality)
        if len(data) <= most:
            path.write_bytes(data)
            print(f"{path.name}: {len(data) / 1e3:.0f} kB, quality {quality}")
            return
    raise ValueError(f"{path.name} has {len(data)} bytes at quality {quality}, expected {most}")


def save_dark(path: Path, most: int) -> None:
    """Write NAME-dark.webp beside a picture: lightness inverted, hues kept, as on the site's dark
    pages (docs/generate/style_sheet.py)."""
    with Image.open(path) as film:
        frames = [np.asarray(frame.convert("RGB")) for frame in ImageSequence.Iterator(film)]
    save([darkened(frame) for frame in frames], path.with_stem(f"{path.stem}-dark"), most)


def darkened(frame: np.ndarray) -> np.ndarray:
    """Convert a frame for a dark page: black becomes white, and white the ground of the page."""
    light = np.clip((1 - frame / 255) @ HUE.T, 0, 1)
    return np.round(255 - (1 - light) * (255 - np.array(DARK))).astype(np.uint8)
