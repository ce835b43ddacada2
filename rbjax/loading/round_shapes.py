"""How far shapes reach across an axle, and where along it they are in the middle.

A convex shape is known by its support h(d) = max over its points of d . x:

    sphere, capsule     h = r |d|  (+ l |d_z|)         cylinder    h = r |(d_x, d_y)| + l |d_z|
    ellipsoid           h = |s d|                      box         h = s . |d|
(Ericson, *Real-Time Collision Detection*, 9.5)
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

#: directions across the axle in which a shape is measured that is not round about it
DIRECTIONS = 360
#: shapes that reach this much of the farthest make the rim
RIM = 1.0 - 1e-6

#: vertices of a mesh that reach this much of the farthest are its rim, without hub and spokes
TREAD = 0.99
#: the sine of an angle up to which a cylinder lies along the axle: that of a file with pi/2 = 1.57
ALIGNED = 1e-3

_GEOM = mujoco.mjtGeom
_LONG = (int(_GEOM.mjGEOM_CYLINDER), int(_GEOM.mjGEOM_CAPSULE))
Frame = tuple[np.ndarray, np.ndarray]


class Round(NamedTuple):
    """radius, m, the farthest point from the axle; centre (3,), on the axle, the middle between
    both sides of what reaches so far."""

    radius: float
    centre: np.ndarray


def round_shape(
    m: mujoco.MjModel, frames: Mapping[int, Frame], anchor: np.ndarray, axis: np.ndarray
) -> Round | None:
    """The extents about an axis of the shapes of bodies whose frames are given.

    Shapes that touch others count; where there are none, those that are only seen.
    """
    own = [g for g in range(m.ngeom) if int(m.geom_bodyid[g]) in frames]
    touching = [g for g in own if m.geom_contype[g] or m.geom_conaffinity[g]]
    extents = [_extents(m, g, frames[int(m.geom_bodyid[g])], anchor, axis) for g in touching or own]
    found = [x for x in extents if x is not None]
    if not found:
        return None
    radius = max(x[0] for x in found)
    rim = [x for x in found if x[0] >= RIM * radius]
    middle = (min(x[1] for x in rim) + max(x[2] for x in rim)) / 2
    return Round(float(radius), anchor + middle * axis)


def _extents(
    m: mujoco.MjModel, g: int, frame: Frame, anchor: np.ndarray, axis: np.ndarray
) -> tuple[float, float, float] | None:
    """The farthest point from the axis, and both ends along it; of a mesh, those of its rim."""
    origin, turn = frame
    place = origin + turn @ m.geom_pos[g]
    own = np.empty(9)
    mujoco.mju_quat2Mat(own, m.geom_quat[g])
    turn = turn @ own.reshape(3, 3)
    away = place - anchor
    if m.geom_type[g] == int(_GEOM.mjGEOM_MESH):
        mesh = int(m.geom_dataid[g])
        at, count = int(m.mesh_vertadr[mesh]), int(m.mesh_vertnum[mesh])
        points = away + m.mesh_vert[at : at + count] @ turn.T
        along = points @ axis
        reach = np.linalg.norm(points - np.outer(along, axis), axis=1)
        rim = along[reach >= TREAD * reach.max()]
        return float(reach.max()), float(rim.min()), float(rim.max())
    if m.geom_type[g] in _LONG and np.linalg.norm(np.cross(axis, turn[:, 2])) < ALIGNED:
        turn = np.stack([*np.linalg.svd(axis[None])[2][1:], axis], 1)
    across = _directions(axis, away)
    reach = _support(int(m.geom_type[g]), m.geom_size[g], np.vstack([across, axis, -axis]) @ turn)
    if reach is None:
        return None
    radius = (reach[:-2] + across @ away).max()
    middle = away @ axis
    return float(radius), float(middle - reach[-1]), float(middle + reach[-2])


def _directions(axis: np.ndarray, away: np.ndarray) -> np.ndarray:
    """Unit vectors across an axis, the first towards a shape that is off it."""
    first = away - (away @ axis) * axis
    if np.linalg.norm(first) < 1e-12:
        first = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    first = first / np.linalg.norm(first)
    angles = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    return np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(axis, first))


def _support(kind: int, size: np.ndarray, d: np.ndarray) -> np.ndarray | None:
    """h in unit directions (n, 3) of the shape's own axes; None of planes and height fields."""
    if kind == int(_GEOM.mjGEOM_SPHERE):
        return np.full(len(d), size[0])
    if kind == int(_GEOM.mjGEOM_CAPSULE):
        return size[0] + size[1] * np.abs(d[:, 2])
    if kind == int(_GEOM.mjGEOM_CYLINDER):
        return size[0] * np.hypot(d[:, 0], d[:, 1]) + size[1] * np.abs(d[:, 2])
    if kind == int(_GEOM.mjGEOM_ELLIPSOID):
        return np.linalg.norm(size * d, axis=1)
    if kind == int(_GEOM.mjGEOM_BOX):
        return np.abs(d) @ size
    return None
