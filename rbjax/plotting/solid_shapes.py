"""Solids fixed to bodies, made from the geoms of a file or of a model: convex ones, and terrain."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import jax
import mujoco
import numpy as np

from rbjax.display import displayed
from rbjax.loading import compile_model
from rbjax.loading.loader import geoms_of
from rbjax.model import Model
from rbjax.model.geoms import Geoms

Array = np.ndarray
#: the largest number of points of a mesh that is drawn without reduction
_MOST_POINTS = 400
#: the largest number of triangles of a mesh that viewers draw without reduction
_MOST_TRIANGLES = 4000


@displayed
@dataclass(frozen=True)
class Solid:
    """A convex solid fixed to a body, or a segment between two bodies.

    points: (n, 3), on the surface, in the body's frame.
    body: index of the body; -1 for the world. The stations of flexible links follow the bodies.
    color: red, green, blue from 0 to 1.
    alpha: opacity.
    end: index of the body that carries the second half of the points, in its frame; None if all
        are in the frame of `body`.
    triangles: (m, 3), indices of points, of a surface that is not convex, such as terrain; None for
        the convex hull of the points.
    mesh: vertices (n, 3) and triangles (m, 3) of a mesh, for viewers that draw triangles; the
        points are then on its convex hull.
    """

    points: Array
    body: int
    color: tuple[float, float, float]
    alpha: float
    end: int | None = None
    triangles: Array | None = None
    mesh: tuple[Array, Array] | None = None

    def placed(self, R: Array, p: Array) -> Array:
        """Compute the points (..., n, 3) in the world, at the bodies' R (..., nb, 3, 3) and p (...,
        nb, 3)."""
        if self.end is None:
            return _placed(self.points, self.body, R, p)
        half = len(self.points) // 2
        ends = (self.points[:half], self.body), (self.points[half:], self.end)
        return np.concatenate([_placed(x, body, R, p) for x, body in ends], -2)


def _placed(points: Array, body: int, R: Array, p: Array) -> Array:
    if body < 0:
        return np.broadcast_to(points, (*R.shape[:-3], *points.shape))
    return points @ np.swapaxes(R[..., body, :, :], -1, -2) + p[..., None, body, :]


def solids(source: Any, *, floating_base: bool = False) -> list[Solid]:
    """Make solids of the visible geoms of a robot, without floors.

    Args:
        source: an argument of `rbjax.load`, or a model. A model has the convex hulls of meshes that
            may touch; if all other geoms of a body are meshes, its hidden geoms (groups above 2)
            are drawn.
        floating_base: as in `rbjax.load`, for a URDF.

    Returns:
        One `Solid` for each geom. A mesh becomes its convex hull, with the mesh itself for viewers,
        reduced to a few thousand triangles. A height field becomes its surface.

    Raises:
        ModelError: the source is not a robot file.

    Example:
        >>> from rbjax.plotting import solids
        >>> len(solids("pendulum"))
        3
    """
    if isinstance(source, Model):
        return [] if source.geoms is None else _of_model(source.geoms)
    m = compile_model(source, floating_base=floating_base)
    meshes = {
        int(i): _mesh(m, int(m.geom_dataid[i]))
        for i in np.flatnonzero(m.geom_type == int(mujoco.mjtGeom.mjGEOM_MESH))
        if m.geom_group[i] <= 2
    }
    hulls = {i: _outermost(vertices) for i, (vertices, _) in meshes.items()}
    return _of_geoms(geoms_of(m, np.asarray), hulls, meshes)


def _of_model(geoms: Geoms) -> list[Solid]:
    """Make the solids of the geoms of a model, which has no visual meshes."""
    geoms = jax.tree.map(np.asarray, geoms)
    hulls = {i: hull.vertices for i, hull in enumerate(geoms.hulls) if hull is not None}
    found = _of_geoms(geoms, hulls)
    bare = {*geoms.bodies} - {s.body for s in found}
    shown = geoms.replace(group=(0,) * len(geoms.types))
    return found + [s for s in _of_geoms(shown, hulls) if s.body in bare]


def _of_geoms(
    geoms: Geoms,
    hulls: Mapping[int, Array],
    meshes: Mapping[int, tuple[Array, Array]] = MappingProxyType({}),
) -> list[Solid]:
    """Make the solids of geoms. hulls: geom index -> points of a mesh; other meshes are omitted.
    meshes: geom index -> vertices and triangles."""
    out = []
    for i, (kind, body) in enumerate(zip(geoms.types, geoms.bodies, strict=True)):
        points: Array | None
        triangles: Array | None = None
        if kind == "hfield" and geoms.fields and geoms.fields[i] >= 0:
            heights = np.asarray(geoms.heights[geoms.fields[i]])
            points, triangles = _terrain(heights, *geoms.size[i, :2])
        else:
            points = hulls.get(i) if kind == "mesh" else _surface(kind, *geoms.size[i])
        *color, alpha = geoms.rgba[i]
        if points is None or geoms.group[i] > 2 or alpha <= 0:
            continue
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, np.asarray(geoms.orientation[i], np.float64))
        turn, place = R.reshape(3, 3).T, np.asarray(geoms.position[i])
        mesh = None
        if i in meshes:
            vertices, faces = meshes[i]
            mesh = vertices @ turn + place, faces
        own = points @ turn + place, body, (color[0], color[1], color[2]), alpha
        out.append(Solid(*own, triangles=triangles, mesh=mesh))
    return out


def _mesh(m: mujoco.MjModel, k: int) -> tuple[Array, Array]:
    """Return vertices (n, 3) and triangles (m, 3) of a mesh. If there are many, vertices in one
    cell of a grid are merged."""
    vertices = m.mesh_vert[m.mesh_vertadr[k] :][: m.mesh_vertnum[k]].astype(float)
    faces = m.mesh_face[m.mesh_faceadr[k] :][: m.mesh_facenum[k]].astype(int)
    cell = np.ptp(vertices, axis=0).max() / 100
    fewer, kept = vertices, faces
    while len(kept) > _MOST_TRIANGLES:
        at = np.floor((vertices - vertices.min(0)) / cell)
        _, own, count = np.unique(at, axis=0, return_inverse=True, return_counts=True)
        own = own.ravel()
        fewer = np.stack([np.bincount(own, x) for x in vertices.T], -1) / count[:, None]
        kept = own[faces]
        whole = (kept != np.roll(kept, 1, axis=1)).all(1)
        kept = np.unique(kept[whole], axis=0)
        cell *= 1.25
    return fewer, kept


def _terrain(heights: Array, x: float, y: float) -> tuple[Array, Array]:
    """Return points (n, 3) and triangles (m, 3) of a height field with half sides x and y."""
    rows, columns = heights.shape
    at = np.meshgrid(np.linspace(-x, x, columns), np.linspace(-y, y, rows))
    points = np.stack([*at, np.asarray(heights, float)], -1).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
    a, b, c, d = corner, corner + 1, corner + columns, corner + columns + 1
    return points, np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])


def sphere(radius: float) -> Array:
    """Return points (n, 3) of a sphere about the origin."""
    return radius * _SPHERE


def ellipsoid(a: float, b: float, c: float) -> Array:
    """Return points (n, 3) of an ellipsoid with semi-axes a, b, c along x, y, z."""
    return _SPHERE * [a, b, c]


def capsule(start: Array, end: Array, radius: float) -> Array:
    """Return points (n, 3) of a rod with round ends between two points."""
    return np.concatenate([sphere(radius) + start, sphere(radius) + end])


def cylinder(radius: float, half: float) -> Array:
    """Return points (n, 3) of a cylinder about z from -half to half."""
    ring = np.stack([radius * np.cos(_TURN), radius * np.sin(_TURN), 0 * _TURN], -1)
    up = np.array([0, 0, half])
    return np.concatenate([ring + up, ring - up])


def _surface(kind: str, a: float, b: float, c: float) -> Array | None:
    """Return points of a geom's surface in its own frame; None for other types, such as planes."""
    if kind == "sphere":
        return sphere(a)
    if kind == "ellipsoid":
        return ellipsoid(a, b, c)
    if kind == "capsule":
        return capsule(np.array([0, 0, b]), np.array([0, 0, -b]), a)
    if kind == "cylinder":
        return cylinder(a, b)
    if kind == "box":
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
        return corners * [a, b, c]
    return None


def _outermost(points: Array) -> Array:
    """Return the points that are farthest in one of many directions, to approximate the hull."""
    if len(points) <= _MOST_POINTS:
        return points
    return points[np.unique((points @ _SPHERE.T).argmax(0))]


_TURN = np.linspace(0, 2 * np.pi, 24, endpoint=False)
_SPHERE = np.array(
    [
        [np.cos(t) * np.sin(e), np.sin(t) * np.sin(e), np.cos(e)]
        for e in np.linspace(0, np.pi, 13)
        for t in _TURN[: 1 if np.sin(e) < 1e-9 else None]
    ]
)
