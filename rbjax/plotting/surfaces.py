"""Triangles of solids: convex hulls with normals, for viewers that shade surfaces.

A vertex has the mean normal of the faces around it, weighted by their angles at the vertex, that
differ by less than 35 degrees (75 if the surface is coarse). So spheres are smooth, and edges of
boxes are sharp. Vertices on an edge are repeated, once for each normal.
"""

from __future__ import annotations

import dataclasses
import itertools
from dataclasses import dataclass

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from rbjax.plotting.solid_shapes import Solid

Array = np.ndarray
#: largest angle between faces that are shaded as one smooth surface, degrees
_CREASE, _COARSE_CREASE = 35.0, 75.0
#: directions of the points that a coarse hull keeps: corners, edges and faces of a cube
_DIRECTIONS = np.array([x for x in itertools.product((-1.0, 0.0, 1.0), repeat=3) if any(x)])


@dataclass(frozen=True)
class Surface:
    """Triangles of a solid. Each vertex is fixed to a body."""

    points: Array  # (n, 3), in the frame of the body of each vertex, m
    normals: Array  # (n, 3), outward unit vectors in the same frame
    bodies: Array  # (n,), the body of each vertex; -1 for the world
    triangles: Array  # (m, 3), vertices, counterclockwise as seen from outside


def surface(solid: Solid, R: Array, p: Array, *, coarse: bool = False) -> Surface | None:
    """Make the surface of a solid; None if it is flat.

    R, p: (n, 3, 3) and (n, 3), poses of the bodies in which the solid is convex.
    coarse: whether to keep only about 26 points, for crowds.
    """
    if solid.mesh is not None and not coarse:
        vertices, faces = solid.mesh
        solid = dataclasses.replace(solid, points=vertices, triangles=faces, mesh=None)
    placed = solid.placed(R, p)
    kept = np.arange(len(placed))
    if solid.triangles is not None:
        triangles = np.asarray(solid.triangles)
    else:
        if coarse:
            kept = np.unique((placed @ _DIRECTIONS.T).argmax(0))
        try:
            hull = ConvexHull(placed[kept])
        except QhullError:
            return None
        triangles = _outward(placed[kept], hull)
    vertex, normals, corners = _with_normals(
        placed[kept], triangles, _COARSE_CREASE if coarse else _CREASE
    )
    vertex = kept[vertex]
    bodies = np.full(len(solid.points), solid.body)
    if solid.end is not None:
        bodies[len(solid.points) // 2 :] = solid.end
    bodies = bodies[vertex]
    if solid.end is not None or solid.body >= 0:
        normals = np.einsum("nji,nj->ni", R[bodies], normals)
    return Surface(solid.points[vertex], normals, bodies, corners)


def _outward(points: Array, hull: ConvexHull) -> Array:
    """Return the triangles (m, 3) of a hull with the corners counterclockwise from outside."""
    triangles = hull.simplices.copy()
    a, b, c = (points[triangles[:, k]] for k in range(3))
    inward = np.einsum("ni,ni->n", np.cross(b - a, c - a), hull.equations[:, :3]) < 0
    triangles[inward] = triangles[inward][:, [0, 2, 1]]
    return triangles


def _with_normals(points: Array, triangles: Array, crease: float) -> tuple[Array, Array, Array]:
    """Compute the normals of the corners of triangles. crease: degrees.

    Returns the point of each vertex (n,), its normal (n, 3), and the triangles as vertices (m, 3).
    """
    at = points[triangles]  # (m, 3, 3)
    flat = _units(np.cross(at[:, 1] - at[:, 0], at[:, 2] - at[:, 0]))
    to, back = _units(np.roll(at, -1, 1) - at), _units(np.roll(at, 1, 1) - at)
    angle = np.arccos(np.clip((to * back).sum(-1), -1, 1)).ravel()
    corner = triangles.ravel()  # (3 m,), the point of each corner
    face = np.repeat(np.arange(len(triangles)), 3)
    order = np.argsort(corner, kind="stable")
    starts = np.searchsorted(corner[order], np.arange(len(points) + 1))
    normals, least = np.zeros((len(corner), 3)), np.cos(np.radians(crease))
    for k in range(len(points)):
        here = order[starts[k] : starts[k + 1]]
        faces = face[here]
        near = flat[faces] @ flat[faces].T > least
        normals[here] = near @ (angle[here, None] * flat[faces])
    normals = _units(normals)
    rows = np.concatenate([corner[:, None], np.round(1000 * normals)], -1)
    _, first, vertices = np.unique(rows, axis=0, return_index=True, return_inverse=True)
    return corner[first], normals[first], vertices.reshape(-1, 3)


def _units(x: Array) -> Array:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-300)
