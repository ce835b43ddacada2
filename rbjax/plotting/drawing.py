"""Pictures of robots on a matplotlib axis, without OpenGL or a window.

The points of each solid are projected along the line of sight, and their convex hull is filled,
far solids first. The shadow is the projection on the floor.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from rbjax.arguments import real_array
from rbjax.contact import ContactForces
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError
from rbjax.model import Model
from rbjax.optional import require
from rbjax.plotting.arguments import check_solids, coordinates
from rbjax.plotting.contact_arrows import strokes, with_arrows
from rbjax.plotting.film import Camera, Film, film
from rbjax.plotting.flexible_links import tubes
from rbjax.plotting.solid_shapes import Solid, solids
from rbjax.plotting.stick_figure import skeleton
from rbjax.style import BLUE, GRID, RED, axes_of, is_dark, rgb

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Array = np.ndarray
#: colours of the ground, of its grid and of shadows, on light and on dark backgrounds
GROUNDS = (("#f4f6f8", GRID, "#e3e7eb"), ("#20272e", "#39434d", "#14191e"))
#: the opacity of the samples after the first
FADED = 0.22


class Outline(NamedTuple):
    """A filled polygon (n, 2) with its colours (red, green, blue, opacity)."""

    points: Array
    face: tuple[float, float, float, float]
    edge: tuple[float, float, float, float]


def outlines(
    shapes: Sequence[Solid], R: Array, p: Array, camera: Camera, *, alpha: float = 1.0,
    world: bool = True, window: Array | None = None,
) -> list[Outline]:  # fmt: skip
    """Compute the outlines of solids in the view, from far to near. R (nb, 3, 3), p (nb, 3).

    window: (2, 2), lower and upper corner of the picture; terrain outside of it is left out.
    """
    axes, found = camera.axes, []
    for s in shapes:
        if s.body < 0 and not world:
            continue
        view = s.placed(R, p) @ axes.T
        if s.triangles is not None:
            found += _terrain(s, view, alpha, window)
            continue
        hull = _hull(view[:, :2])
        if hull is not None:
            (red, green, blue), opacity = s.color, alpha * s.alpha
            face = (red, green, blue, opacity)
            edge = (0.62 * red, 0.62 * green, 0.62 * blue, opacity)
            if s.end is not None:  # a segment of a tube: opaque, since segments overlap
                red, green, blue = (1 - opacity * (1 - x) for x in s.color)
                face = edge = (red, green, blue, 1.0)
            outline = Outline(hull, face, edge)
            found.append((float(view[:, 2].mean()), outline))
    return [outline for _, outline in sorted(found, key=lambda item: item[0])]


def _terrain(
    s: Solid, view: Array, alpha: float, window: Array | None
) -> list[tuple[float, Outline]]:
    """Return the triangles of a surface that face the eye, with their depths. view: (n, 3)."""
    assert s.triangles is not None
    corners = view[s.triangles]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing = area[:, 2] / np.maximum(np.linalg.norm(area, axis=-1), 1e-300)
    shown, out = facing > 0, []
    if window is not None:
        inside = (corners[..., :2] > window[0]) & (corners[..., :2] < window[1])
        shown &= inside.any(1).all(-1)
    for k in np.flatnonzero(shown):
        red, green, blue = (float(x * (0.55 + 0.45 * facing[k])) for x in s.color)
        face = (red, green, blue, alpha * s.alpha)
        out.append((float(corners[k, :, 2].mean()), Outline(corners[k, :, :2], face, face)))
    return out


def shadows(
    shapes: Sequence[Solid], R: Array, p: Array, camera: Camera, *, floor: float = 0.0,
    world: bool = True,
) -> list[Array]:  # fmt: skip
    """Project solids vertically onto the floor. Return the outlines (n, 2) in image coordinates.

    world: whether solids of the world have shadows too.
    """
    hulls = []
    for s in shapes:
        if s.triangles is None and (s.body >= 0 or world):
            hulls.append(_hull((s.placed(R, p) * [1, 1, 0] + [0, 0, floor]) @ camera.axes[:2].T))
    return [hull for hull in hulls if hull is not None]


def _hull(points: Array) -> Array | None:
    try:
        return points[ConvexHull(points).vertices]
    except QhullError:  # a flat solid in the line of sight
        return None


def draw_solids(
    shapes: Sequence[Solid],
    R: Array,
    p: Array,
    *,
    ax: Axes | None = None,
    camera: Camera | None = None,
    alpha: float = 1.0,
    shadow: bool = True,
    world: bool = True,
    zorder: float = 2.0,
) -> Axes:
    """Draw solids at one pose, as patches of an axis.

    Args:
        shapes: a list from `solids` or `skeleton`.
        R: (n, 3, 3), body to world axes, as from `poses`.
        p: (n, 3), the bodies' origins in the world's frame, m.
        ax: the axis to draw on; None makes a figure.
        camera: the line of sight.
        alpha: opacity.
        shadow: whether they cast a shadow on z = 0.
        world: whether to draw the solids that are fixed to the world.
        zorder: matplotlib's zorder of the farthest solid.

    Returns:
        The axis.

    Raises:
        InputError: R and p do not fit the solids, or an opacity outside of 0 to 1.

    Example:
        >>> import matplotlib.figure, numpy as np
        >>> from rbjax.plotting import draw_solids, solids
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> R, p = np.eye(3)[None], np.zeros((1, 3))
        >>> len(draw_solids(solids("pendulum"), R, p, ax=ax, shadow=False).patches)
        3
    """
    new, ax = ax is None, axes_of("draw_solids", ax)
    R, p = check_solids("draw_solids", shapes, R, p, alpha)
    camera, Polygon = camera or Camera(), require("draw", "matplotlib.patches").Polygon
    if shadow:
        for hull in shadows(shapes, R, p, camera, world=world):
            ax.add_patch(Polygon(hull, color="#000", alpha=0.06 * alpha, lw=0, zorder=zorder - 1))
    for depth, one in enumerate(outlines(shapes, R, p, camera, alpha=alpha, world=world)):
        style: Any = {"facecolor": one.face, "edgecolor": one.edge, "zorder": zorder + 1e-3 * depth}
        ax.add_patch(Polygon(one.points, lw=0.7, joinstyle="round", **style))
    if new:
        ax.set_aspect("equal")
        ax.autoscale_view()
        ax.axis("off")
    return ax


class Stage:
    """A matplotlib axis that displays the frames of a film."""

    def __init__(self, ax: Axes, film: Film):
        self.ax, self.film = ax, film
        artists = require("draw", "matplotlib.collections")
        PolyCollection, LineCollection = artists.PolyCollection, artists.LineCollection
        ground, grid, shadow = GROUNDS[is_dark(ax.figure)]
        self.disc = PolyCollection([], facecolors=ground, linewidths=0, zorder=0)
        self.grid = LineCollection([], colors=grid, linewidths=0.8, zorder=0.5)
        # opaque, so that overlapping shadows do not become darker
        self.shadow = PolyCollection([], facecolors=shadow, linewidths=0, zorder=1)
        first = [(*rgb(BLUE), 1.0 if strong else FADED) for strong in film.strong]
        self.paths = LineCollection([], colors=first, linewidths=1.6, zorder=1.5)
        self.forces = LineCollection([], colors=RED, linewidths=1.8, zorder=4)
        self.points = ax.scatter([], [], s=14, color=RED, zorder=5, linewidths=0)
        self.solids = PolyCollection([], linewidths=0.8, zorder=2, joinstyle="round")
        for collection in (self.disc, self.grid, self.shadow, self.paths, self.forces, self.solids):
            ax.add_collection(collection, autolim=False)
        ax.axis("off")
        # a layout that changes the axis later may shrink the picture, but not cut it
        ax.set_aspect("equal", adjustable="box")

    def show(self, frame: int) -> None:
        """Draw a frame, and remove the previous one."""
        f, axes = self.film, self.film.camera.axes[:2]
        centre, half = f.centre[frame] @ axes.T, f.size / 2 * [1.0, 1.15]  # title and time
        width, height = self.ax.get_window_extent().size
        half = np.maximum(half, half[::-1] * [width / height, height / width])
        self.ax.set(
            xlim=(centre[0] - half[0], centre[0] + half[0]),
            ylim=(centre[1] - half[1], centre[1] + half[1]),
        )
        disc, grid = ground(f, frame, float(np.hypot(*half)))
        self.disc.set_verts([disc @ axes.T])
        self.grid.set_segments([line @ axes.T for line in grid])
        self.shadow.set_verts(
            shadows(f.shapes, f.R[0, frame], f.p[0, frame], f.camera, floor=f.floor)
        )
        self.paths.set_segments([path[: frame + 1] @ axes.T for path in f.paths])
        if f.arrows is not None:
            own = f.arrows[frame]
            self.forces.set_segments(strokes(own, axes, 0.04 * f.size.max()))
            self.points.set_offsets(own[~np.isnan(own[:, 0, 0]), 0] @ axes.T)
        shown = []
        for sample in reversed(range(len(f.R))):  # the first sample is in front
            style: Any = {"alpha": 1.0 if sample == 0 else FADED, "world": sample == 0}
            style["window"] = centre + np.array([-half, half])
            shown += outlines(f.shapes, f.R[sample, frame], f.p[sample, frame], f.camera, **style)
        self.solids.set_verts([one.points for one in shown])
        self.solids.set_facecolor([one.face for one in shown])
        self.solids.set_edgecolor([one.edge for one in shown])


def ground(film: Film, frame: int, reach: float) -> tuple[Array, list[Array]]:
    """Compute a disc (n, 3) of the ground below the middle of a frame, and the lines of its
    grid."""
    x, y, _ = film.centre[frame]
    radius, spacing = 1.1 * reach, _even(reach / 2.5)
    turn = np.linspace(0, 2 * np.pi, 97)
    disc = np.stack(
        [x + radius * np.cos(turn), y + radius * np.sin(turn), 0 * turn + film.floor], -1
    )
    lines = []
    for along, middle in ((0, y), (1, x)):
        start = x if along == 0 else y
        for k in np.arange(np.ceil((middle - radius) / spacing), (middle + radius) / spacing):
            half = np.sqrt(max(radius**2 - (k * spacing - middle) ** 2, 0.0))
            line = np.full((2, 3), film.floor)
            line[:, along] = start - half, start + half
            line[:, 1 - along] = k * spacing
            lines.append(line)
    return disc, lines


def _even(length: float) -> float:
    """Return the largest of 1, 2 and 5 times a power of ten that does not exceed a length."""
    power = 10.0 ** np.floor(np.log10(length))
    return float(power * max(k for k in (1, 2, 5) if k * power <= length * 1.0000001))


def shapes_of(model: Model, source: Any, floating_base: bool = False) -> list[Solid]:
    """Return the geoms of a file, or else of the model; a skeleton if there are no geoms.

    The flexible links are those of the model.
    """
    found = [] if source is None else solids(source, floating_base=floating_base) or solids(model)
    if source is not None and not found:
        warnings.warn(
            "no shapes of the source are drawn (visuals and meshes of a URDF are not read): the "
            "robot is drawn as rods between its joints and ellipsoids of inertia, as with "
            "source=None; to see its shapes, give an MJCF file with geoms",
            stacklevel=3,
        )
    return [*found, *tubes(model)] if found else skeleton(model)


def draw(
    model: Model,
    q: Any,
    *,
    ax: Axes | None = None,
    source: Any = None,
    camera: Camera | None = None,
    contacts: ContactForces | None = None,
) -> Axes:
    """Draw one posture of a robot, with the ground, and the forces of its contacts.

    Args:
        model: one robot.
        q: (nq,) configuration, or a `State`.
        ax: the axis to draw on; None makes a figure.
        source: the argument of `rbjax.load`, to draw the file's geoms. None draws rods from joint
            to joint and ellipsoids of inertia.
        camera: the line of sight; None chooses one.
        contacts: contact forces to draw as arrows, as `rb.contact.solve(...).contacts`. An arrow of
            the robot's weight has a third of the height of the picture.

    Returns:
        The axis. `ax.figure.savefig(path)` writes it to a file.

    Raises:
        InputError: q has another shape or is not finite.

    Example:
        >>> import matplotlib.figure
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> ax = matplotlib.figure.Figure().add_subplot()
        >>> rb.plotting.draw(model, [0.3, 0.5], ax=ax).get_aspect()
        1.0
    """
    check_model("draw", model)
    q = real_array("draw", "q", coordinates(q), finite=False).astype(model.joints.reference.dtype)
    if q.shape != (model.nq,) or not np.isfinite(q).all():
        raise InputError(f"draw: got q = {q}, expected shape ({model.nq},) of finite numbers")
    shapes = shapes_of(model, source)
    shown = film(model, np.zeros(1), q[None, None], shapes, camera=camera)
    ax = axes_of("draw", ax)
    Stage(ax, with_arrows("draw", shown, model, contacts)).show(0)
    return ax
