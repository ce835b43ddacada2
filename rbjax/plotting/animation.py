"""Animation of a trajectory as a GIF, an MP4, or an HTML page with an interactive view."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rbjax.arguments import file_path
from rbjax.contact import ContactForces
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting import movie_files, offscreen
from rbjax.plotting.arguments import check_film, check_size
from rbjax.plotting.contact_arrows import with_arrows
from rbjax.plotting.drawing import Stage, shapes_of
from rbjax.plotting.film import Camera, Film, film, frames
from rbjax.plotting.movie_files import canvas_of, clock, picture
from rbjax.plotting.web_page import write_page
from rbjax.style import INK

SUFFIXES = (".gif", ".mp4", ".html")
RENDERERS = ("drawing", "mujoco")


def animate(
    model: Model,
    trajectory: Trajectory,
    path: str | Path,
    *,
    source: Any = None,
    floating_base: bool = False,
    fps: float = 25.0,
    speed: float = 1.0,
    samples: int = 8,
    camera: Camera | None = None,
    follow: bool | None = None,
    tracked: str | None = None,
    trace: str | Sequence[str] = (),
    contacts: ContactForces | None = None,
    title: str = "",
    size: tuple[int, int] = (800, 600),
    renderer: str = "drawing",
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """Write an animation of a trajectory.

    Without `source` the robot is drawn from its parameters, as rods from joint to joint and
    ellipsoids of inertia. The suffix of the file determines the format: .gif; .mp4, which requires
    ffmpeg; or .html, a self-contained page (WebGL 2). In the page the mouse turns the view. It has
    controls for speed, the camera, contact forces, and ghosts: the other samples of a batch, up to
    thousands.

    Args:
        model: the robot that moved.
        trajectory: of `rollout` or `simulate`; q (T, nq) or (B, T, nq), times in s. Frames
            between its states are interpolated.
        path: the file to write, .gif, .mp4 or .html.
        source: the argument of `rbjax.load`, to draw the file's geoms.
        floating_base: as in `rbjax.load`, for a source that is a URDF.
        fps: frames per second of the animation.
        speed: seconds of motion per second of the animation; 0.1 is slow motion.
        samples: the number of samples of a batch to draw. All but the first are faded. An HTML
            page draws thousands; above some megabytes it has fewer frames of them.
        camera: the line of sight. None chooses a right angle to a flat motion, or else a corner.
        follow: whether the view moves with the robot; None: only if the robot moves far.
        tracked: name of the body that the view follows; None for the middle of the robot.
        trace: one body or several, whose origins leave a line.
        contacts: contact forces at the times of the trajectory, drawn as arrows, as
            `jax.vmap(lambda q, v: rb.contact.solve(model, rb.State(q, v)).contacts)` returns.
        title: text at the top.
        size: width and height in pixels (of .gif and .mp4).
        renderer: "drawing", or "mujoco" to render `source` by MuJoCo. That requires OpenGL (EGL or
            OSMesa if there is no display), and shows the first sample.
        progress: called with the number of frames done and their total; None displays a progress
            bar in a terminal.

    Returns:
        The path.

    Raises:
        InputError: another suffix or renderer, a trajectory of another model, ffmpeg missing.

    Example:
        >>> import pathlib, tempfile
        >>> import jax.numpy as jnp, rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> run = rb.rollout(model, rb.State(jnp.ones(2), jnp.zeros(2)), None, 0.01, steps=20)
        >>> file = pathlib.Path(tempfile.mkdtemp()) / "swing.html"
        >>> rb.plotting.animate(model, run, file).name
        'swing.html'
    """
    path = file_path("animate", path)
    writable(path)
    check_film(
        "animate", model, trajectory, fps=fps, speed=speed, samples=samples, camera=camera,
        follow=follow, tracked=tracked, trace=trace, title=title, floating_base=floating_base,
    )  # fmt: skip
    trace = (trace,) if isinstance(trace, str) else tuple(trace)
    _check(renderer, source)
    check_size("animate", size)
    ts, q = frames(model, trajectory, fps, speed, samples)
    shapes = shapes_of(model, source, floating_base)
    options: Any = {"camera": camera, "follow": follow, "tracked": tracked, "trace": trace}
    shown = film(model, ts, q, shapes, **options)
    shown = with_arrows("animate", shown, model, contacts, np.asarray(trajectory.ts, float))
    if path.suffix == ".html":
        write_page(path, shown, title, fps=fps, speed=speed)
        return path
    pictures: Iterable[np.ndarray] = _drawn(shown, title, speed, size)
    if renderer == "mujoco":
        rendered = offscreen.render(source, floating_base, q[0], shown, size)
        if rendered is not None:
            pictures = _labelled(rendered, shown, title, speed, size)
    movie_files.write(path, pictures, len(ts), fps, progress)
    return path


def writable(path: Path) -> None:
    """Raise InputError if `animate` cannot write a file with this path, before anything is
    computed."""
    movie_files.check("animate", path, SUFFIXES)


def _check(renderer: str, source: Any) -> None:
    if not isinstance(renderer, str) or renderer not in RENDERERS:
        raise InputError(f"animate: renderer {renderer!r}, expected one of {', '.join(RENDERERS)}")
    if renderer == "mujoco" and source is None:
        raise InputError("animate: renderer 'mujoco' draws a robot file: give it as source=")


def _figure(film: Film, title: str, speed: float, size: tuple[int, int]) -> tuple[Any, Any, Any]:
    """Make a canvas with one axis, and a text object for the time."""
    canvas, figure = canvas_of(size)
    ax = figure.add_axes((0, 0, 1, 1))
    height = 12 * min(1.0, size[0] / 600)
    figure.text(0.025, 0.965, title, size=height, weight="bold", color=INK, va="top")
    label = figure.text(0.025, 0.03, "", size=height, color=INK, family="monospace")
    return canvas, ax, label


def _drawn(film: Film, title: str, speed: float, size: tuple[int, int]) -> Iterator[np.ndarray]:
    """Draw the frames (height, width, 3) of a film with matplotlib."""
    canvas, ax, label = _figure(film, title, speed, size)
    stage = Stage(ax, film)
    for frame in range(len(film.ts)):
        stage.show(frame)
        label.set_text(clock(film.ts[frame], speed))
        yield picture(canvas)


def _labelled(
    rendered: Iterable[np.ndarray], film: Film, title: str, speed: float, size: tuple[int, int]
) -> Iterator[np.ndarray]:
    """Add the title and the time to MuJoCo's pictures."""
    canvas, ax, label = _figure(film, title, speed, size)
    ax.axis("off")
    shown = None
    for text in canvas.figure.texts:
        text.set_bbox({"facecolor": "white", "alpha": 0.75, "lw": 0, "pad": 3})
    canvas.figure.texts[0].set_visible(bool(title))
    for frame, image in enumerate(rendered):
        if shown is None:
            shown = ax.imshow(image, aspect="auto")
        shown.set_data(image)
        label.set_text(clock(film.ts[frame], speed))
        yield picture(canvas)
