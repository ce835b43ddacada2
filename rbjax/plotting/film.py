"""Content of a picture before it is drawn: poses at equal times, and a view that fits them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics import difference, forward_kinematics, integrate
from rbjax.errors import InputError
from rbjax.model import WORLD, Model
from rbjax.motion.trajectory import Trajectory
from rbjax.plotting.arguments import configurations
from rbjax.plotting.flexible_links import station_poses
from rbjax.plotting.movie_files import schedule
from rbjax.plotting.solid_shapes import Solid

Array = np.ndarray
#: the number of frames from which the view is computed
_PROBED = 60
#: the number of entries of rotations from which poses are kept in single precision
_MANY = 20_000_000
#: the number of samples of a batch from which the view is computed
_SAMPLES = 16
#: the camera follows the robot if it moves more than this many times its size
_FAR = 4.0


@dataclass(frozen=True)
class Camera:
    """An orthographic camera, by azimuth and elevation in degrees.

    Example:
        >>> from rbjax.plotting import Camera
        >>> Camera(azimuth=-90.0, elevation=0.0).axes.round(3) + 0.0  # x to the right, z up
        array([[ 1.,  0.,  0.],
               [ 0.,  0.,  1.],
               [ 0., -1.,  0.]])
    """

    azimuth: float = -60.0
    elevation: float = 12.0

    @property
    def axes(self) -> Array:
        """Unit vectors (3, 3) by row: right, up, towards the eye."""
        a, e = np.radians(self.azimuth), np.radians(self.elevation)
        eye = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
        right = np.array([-np.sin(a), np.cos(a), 0.0])
        return np.stack([right, np.cross(eye, right), eye])


def facing(points: Array) -> Camera:
    """Choose the camera for points (n, 3): at a right angle to a vertical plane, or from a corner.

    The first case applies if the points are nearly in a vertical plane.
    """
    spread = np.cov(points[:, :2].T)
    values, vectors = np.linalg.eigh(spread)
    if values[1] > 0 and values[0] < 0.1**2 * values[1]:
        thin = vectors[:, 0]
        # from the front (-y) or the right (+x), so that x or y grows to the right
        thin = thin if thin @ (1e-6, -1.0) > 0 or abs(thin[1]) < 1e-6 < thin[0] else -thin
        return Camera(float(np.degrees(np.arctan2(thin[1], thin[0]))), 10.0)
    return Camera(-60.0, 16.0)


@dataclass(frozen=True)
class Film:
    """Poses of samples at all frames, and the view, in the world's frame, in m."""

    ts: Array  # (F,), s
    R: Array  # (S, F, n, 3, 3), rotations of bodies, and of stations of flexible links
    p: Array  # (S, F, n, 3), their positions
    shapes: Sequence[Solid]
    camera: Camera  # the line of sight
    floor: float  # the height of the ground
    centre: Array  # (F, 3), the middle of the picture
    size: Array  # (2,), the least width and height of the picture
    paths: Array  # (n, F, 3), positions of bodies whose paths are drawn
    strong: tuple[bool, ...] = ()  # (n,), whether each path is of the first sample
    arrows: Array | None = None  # (F, n, 2, 3), start and end of contact forces, or nan
    middle: Array | None = None  # (F, 3), the tracked body or the middle of the first sample
    follow: bool = False  # whether `centre` moves with the robot


def poses(model: Model, q: Array) -> tuple[Array, Array]:
    """Compute rotations (T, n, 3, 3) and positions (T, n, 3) of the bodies along q (T, nq).

    The stations of flexible links follow the bodies (`rbjax.plotting.flexible_links`).

    Args:
        model: the robot.
        q: (T, nq), m and rad; or states, such as a `Trajectory`.

    Returns:
        Rotations (T, n, 3, 3) and positions (T, n, 3), m, in the world.

    Raises:
        InputError: q has another shape, or is not finite.

    Example:
        >>> import numpy as np
        >>> import rbjax as rb
        >>> from rbjax.plotting import poses
        >>> R, p = poses(rb.load("pendulum"), np.zeros((3, 1)))
        >>> R.shape, p.shape
        ((3, 1, 3, 3), (3, 1, 3))
    """
    q = configurations("poses", model, q)
    R, p = jax.jit(jax.vmap(forward_kinematics, (None, 0)))(model, jnp.asarray(q))
    kind = float if R.size < _MANY else np.float32
    return station_poses(model, np.asarray(R, kind), np.asarray(p, kind), q)


def frames(
    model: Model, trajectory: Trajectory, fps: float, speed: float, samples: int
) -> tuple[Array, Array]:
    """Compute the times (F,) of frames, s, and the configurations (S, F, nq) at them.

    Frames are 1/fps s apart. Between saved states, configurations are interpolated along geodesics.
    States after one that is not finite are omitted, with a warning.
    """
    ts, q = np.asarray(trajectory.ts, float), np.asarray(trajectory.q)
    q = q[None] if q.ndim == 2 else q[:samples]
    if q.ndim != 3 or q.shape[1:] != (len(ts), model.nq) or not q.size:
        raise InputError(
            f"animate: trajectory.q has shape {np.shape(trajectory.q)}, expected "
            f"({len(ts)}, {model.nq}) or (B, {len(ts)}, {model.nq}) for this model and its "
            f"{len(ts)} times: give the model that made the trajectory"
        )
    kept, wanted = schedule("animate", ts, q, fps, speed)
    ts, q = ts[:kept], q[:, :kept]
    if kept == 1:
        return wanted, q[:, :1]
    before = np.clip(np.searchsorted(ts, wanted, side="right") - 1, 0, kept - 2)
    share = (wanted - ts[before]) / np.maximum(ts[before + 1] - ts[before], 1e-300)

    def between(q0: Any, q1: Any, w: Any) -> Any:
        return integrate(model, q0, w * difference(model, q0, q1))

    blend = jax.jit(jax.vmap(jax.vmap(between), (0, 0, None)))
    share = np.clip(share, 0.0, 1.0).astype(q.dtype)
    return wanted, np.asarray(blend(q[:, before], q[:, before + 1], share))


def film(
    model: Model,
    ts: Array,
    q: Array,
    shapes: Sequence[Solid],
    *,
    camera: Camera | None = None,
    follow: bool | None = None,
    tracked: str | None = None,
    trace: Sequence[str] = (),
) -> Film:
    """Make a film of configurations q (S, F, nq), with a view that fits them; the arguments are
    those of `animate`. `tracked` None is the middle of the robot.
    """
    samples, count = q.shape[:2]
    R, p = poses(model, q.reshape(-1, model.nq))
    R, p = R.reshape(samples, count, *R.shape[1:]), p.reshape(samples, count, *p.shape[1:])
    probed = np.unique(np.linspace(0, count - 1, min(count, _PROBED)).astype(int))
    if not shapes:
        raise InputError("nothing to draw: the model has no body with a size, the file no geom")
    # (S, probed, n, 3): the points of the solids of some samples, and which of them move
    convex = [s for s in shapes if s.triangles is None] or list(shapes)
    few = np.unique(np.linspace(0, samples - 1, min(samples, _SAMPLES)).astype(int))
    at = R[few][:, probed], p[few][:, probed]
    points = np.concatenate([s.placed(*at) for s in convex], axis=2)
    moving = np.concatenate([np.full(len(s.points), s.body >= 0) for s in convex])
    camera = camera or facing(points.reshape(-1, 3))
    robot = points[:, :, moving] if moving.any() else points
    middle, own = robot.mean((0, 2)), robot[0].mean(1)  # (probed, 3)
    if tracked is not None:
        body = model.body(tracked)
        middle, own = at[1][:, :, body].mean(0), at[1][0, :, body]
    seen = robot @ camera.axes[:2].T
    at_once = (seen.max((0, 2)) - seen.min((0, 2))).max()
    across = np.ptp(middle @ camera.axes[:2].T, axis=0).max()
    extent = float(np.ptp(points.reshape(-1, 3), axis=0).max()) or 1.0
    if follow is None:
        follow = bool(across > _FAR * at_once)
    own = np.stack([np.interp(np.arange(count), probed, x) for x in own.T], -1)
    if follow:
        centre = np.stack([np.interp(np.arange(count), probed, x) for x in middle.T], -1)
        reach = (robot - middle[:, None]) @ camera.axes[:2].T
        size = 2.2 * np.abs(reach).max((0, 1, 2))
    else:
        view = points @ camera.axes.T
        low, high = view.min((0, 1, 2)), view.max((0, 1, 2))
        centre = np.tile((low + high) / 2 @ camera.axes, (count, 1))
        size = 1.1 * (high - low)[:2]
    lowest = float(robot[..., 2].min())
    floor = 0.0 if -0.01 * extent <= lowest <= 0.6 * extent else lowest - 0.05 * extent
    floor = _plane_height(model, floor)
    terrain = [s.points[:, 2].min() for s in shapes if s.triangles is not None and s.body < 0]
    floor = float(min(terrain)) - 1e-3 * extent if terrain else floor
    if not follow:
        size, centre = _with_floor(size, centre, camera, floor)
    traced = range(min(samples, _SAMPLES))
    paths = np.array([p[s, :, model.body(name)] for name in trace for s in traced])
    paths, size = paths.reshape(-1, count, 3), np.maximum(size, 1e-6)
    strong = tuple(s == 0 for _ in trace for s in traced)
    return Film(
        ts, R, p, shapes, camera, floor, centre, size, paths, strong, middle=own, follow=follow
    )


def _plane_height(model: Model, otherwise: float) -> float:
    """Return the height of the highest horizontal plane of a model, m; `otherwise` without one."""
    geoms, heights = model.geoms, []
    if geoms is not None:
        at, turn = np.asarray(geoms.position, float), np.asarray(geoms.orientation, float)
        heights = [
            float(at[i, 2])
            for i, (kind, body) in enumerate(zip(geoms.types, geoms.bodies, strict=True))
            if kind == "plane" and body == WORLD and np.hypot(*turn[i, 1:3]) < 1e-6
        ]
    return max(heights, default=otherwise)


def _with_floor(size: Array, centre: Array, camera: Camera, floor: float) -> tuple[Array, Array]:
    """Extend the view down to the ground under its middle."""
    up = camera.axes[1]
    ground = np.array([*centre[0, :2], floor])
    below = (centre[0] - ground) @ up - size[1] / 2 + 0.06 * size.max()
    if below <= 0:
        return size, centre
    return size + np.array([0.0, below]), centre - 0.5 * below * up
