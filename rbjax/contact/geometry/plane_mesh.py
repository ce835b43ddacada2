"""Contacts of a plane with the convex hull of a mesh.

The face of the hull at its deepest vertex that is most parallel to the plane has the contacts: up
to four of its corners. Corners above the origin of the geom are left out. MuJoCo C has the same
contacts, but for some faces of more than four corners, of which it may keep another corner.
"""

from __future__ import annotations

import jax.numpy as jnp

from rbjax.contact.geometry.shapes import Contact, Shape
from rbjax.lanes import Lane, Vec3

#: contacts of a plane and a hull, at most
CORNERS = 4


def plane_mesh(plane: Shape, mesh: Shape, reach: Lane) -> list[Contact]:
    """Return up to four contacts of a plane with the corners of a face of a hull."""
    hull, n = mesh.surface, plane.axis
    down = mesh.R.T @ n
    dtype = jnp.result_type(down[0])
    vertices = jnp.asarray(hull.vertices, dtype)
    deepest = jnp.argmin(_along(vertices, down))
    normals = jnp.asarray(hull.normals, dtype)[deepest]
    face = jnp.argmin(_along(normals, down))
    corners = jnp.asarray(hull.corners)[deepest, face]
    out = []
    for k in range(CORNERS):
        v = vertices[jnp.maximum(corners[k], 0)]
        corner = mesh.R @ Vec3(v[0], v[1], v[2])
        point = mesh.p + corner
        distance = n.dot(point - plane.p)
        exists = (corners[k] >= 0) & (distance <= reach) & (n.dot(corner) <= 0)
        out.append(Contact(distance, point - n * (0.5 * distance), n, exists))
    return out


def _along(rows: jnp.ndarray, direction: Vec3) -> jnp.ndarray:
    """Return the component of each row (n, 3) along a direction."""
    x, y, z = direction
    return rows[:, 0] * x + rows[:, 1] * y + rows[:, 2] * z
