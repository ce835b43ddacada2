"""Movie files: times of frames, a canvas, and writers of GIF (Pillow) and MP4 (ffmpeg)."""

from __future__ import annotations

import shutil
import subprocess
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbjax.errors import InputError, RbjaxError
from rbjax.optional import require
from rbjax.progress import progress_bar
from rbjax.style import PAPER

if TYPE_CHECKING:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

#: the number of colours of a GIF
_COLORS = 128
_DPI = 100


def check(where: str, path: Path, suffixes: Sequence[str]) -> None:
    """Raise InputError if a file with this path cannot be written here."""
    if path.suffix not in suffixes:
        raise InputError(
            f"{where}: got the file name {path.name!r}, expected one that ends in "
            f"{', '.join(suffixes)}"
        )
    if not path.absolute().parent.is_dir():
        raise InputError(f"{where}: no such folder: {path.parent}; make it first")
    if path.suffix == ".mp4" and ffmpeg() is None:
        others = " or ".join(path.stem + suffix for suffix in suffixes if suffix != ".mp4")
        raise InputError(
            f"{where}: {path.name} needs ffmpeg, which is not installed here: write {others} "
            "instead"
        )
    if path.suffix in (".gif", ".mp4"):
        for package in ("matplotlib", "PIL"):
            require(where, package, f"write {path.stem}.html")


def write(
    path: Path,
    pictures: Iterable[np.ndarray],
    total: int,
    fps: float,
    progress: Callable[[int, int], None] | None,
) -> None:
    """Write `total` pictures as a GIF or an MP4.

    progress: a function of the number done and the total; None for a progress bar.
    """
    into = gif if path.suffix == ".gif" else mp4
    if progress is not None:
        into(path, _counted(pictures, total, progress), fps)
        return
    with progress_bar(f"drawing {path.name}", total) as say:
        into(path, _counted(pictures, total, lambda done, total: say(done)), fps)


def _counted(
    pictures: Iterable[np.ndarray], total: int, progress: Callable[[int, int], None]
) -> Iterator[np.ndarray]:
    for done, picture in enumerate(pictures, 1):
        yield picture
        progress(done, total)


def gif(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """Write pictures (height, width, 3) of bytes as a GIF, whose durations are multiples of 10
    ms."""
    Image = require("animate", "PIL.Image")
    images = [
        Image.fromarray(picture).quantize(_COLORS, dither=Image.Dither.NONE) for picture in pictures
    ]
    edges = np.round(100.0 / fps * np.arange(len(images) + 1))
    # browsers slow down animations of more than 50 frames a second
    durations = [max(20, 10 * int(d)) for d in np.diff(edges)]
    durations[-1] = max(durations[-1], 700)  # a pause before it repeats
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=durations, loop=0, optimize=True
    )


def ffmpeg() -> str | None:
    """Return the path of the ffmpeg program, or None."""
    return shutil.which("ffmpeg")


def mp4(path: Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """Write pictures (height, width, 3) of bytes as an MP4 in H.264, which every browser plays."""
    program, process = ffmpeg(), None
    assert program is not None, "animate has looked"
    with tempfile.TemporaryFile() as said:
        for picture in pictures:
            if process is None:
                process = subprocess.Popen(
                    _command(program, path, picture.shape[:2], fps),
                    stdin=subprocess.PIPE,
                    stdout=subprocess.DEVNULL,
                    stderr=said,
                )
            assert process.stdin is not None
            try:
                process.stdin.write(picture.tobytes())
            except BrokenPipeError:  # ffmpeg has ended; its message is in `said`
                break
        assert process is not None and process.stdin is not None, "a film has a frame"
        process.communicate()
        if process.returncode:
            said.seek(0)
            raise RbjaxError(
                f"ffmpeg wrote no {path}; it said: {said.read().decode(errors='replace').strip()}"
            )


def _command(program: str, path: Path, shape: tuple[int, ...], fps: float) -> list[str]:
    given = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", f"{shape[1]}x{shape[0]}", "-r", f"{fps}"]
    # browsers require yuv420p, which needs even numbers of pixels
    wanted = ["-vf", "crop=trunc(iw/2)*2:trunc(ih/2)*2", "-pix_fmt", "yuv420p", "-crf", "18"]
    return [program, "-y", "-loglevel", "error", *given, "-i", "-", *wanted, str(path)]


def schedule(
    where: str, ts: np.ndarray, q: np.ndarray, fps: float, speed: float
) -> tuple[int, np.ndarray]:
    """Compute the number of states to draw, and the times (F,) of frames, s, 1/fps s apart.

    ts is (T,), q (..., T, nq). States after one that is not finite are omitted, with a warning.
    """
    others = tuple(k for k in range(q.ndim) if k != q.ndim - 2)
    whole = np.isfinite(q).all(others) & np.isfinite(ts)
    kept = len(ts) if whole.all() else int(whole.argmin())
    if not kept:
        raise InputError(f"{where}: the first state is not finite, expected numbers to draw")
    if kept < len(ts):
        warnings.warn(
            f"the motion is not finite after t = {ts[kept - 1]:.4g} s; the rest is left out",
            stacklevel=4,
        )
    count = 1 + int(np.floor((ts[kept - 1] - ts[0]) * fps / speed + 1e-6))
    return kept, ts[0] + np.arange(count) * speed / fps


def canvas_of(size: tuple[int, int]) -> tuple[FigureCanvasAgg, Figure]:
    """Make a canvas of a size in pixels, and its figure."""
    Figure = require("animate", "matplotlib.figure").Figure
    figure = Figure(figsize=(size[0] / _DPI, size[1] / _DPI), dpi=_DPI, facecolor=PAPER)
    return require("animate", "matplotlib.backends.backend_agg").FigureCanvasAgg(figure), figure


def picture(canvas: Any) -> np.ndarray:
    """Draw a canvas. Return its pixels (height, width, 3)."""
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def clock(t: float, speed: float) -> str:
    """Format the time and the speed of playback as text."""
    rate = "" if speed == 1 else f"   {speed:g} x real time"
    return f"t = {t:.2f} s{rate}"
