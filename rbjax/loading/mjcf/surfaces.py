"""Surfaces of geoms that are not primitives: convex hulls of meshes, and height fields."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

import mujoco
import numpy as np

from rbjax.model.hulls import Hull


def surface_fields(
    m: mujoco.MjModel, pairs: Collection[tuple[int, int]], array: Callable
) -> dict[str, Any]:
    """Return the fields of `Geoms` of hulls and height fields.

    A hull is kept if its mesh may touch a plane. array: function that makes a leaf of a model.
    """
    plane, mesh, hfield = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{x}")) for x in _KINDS)
    kinds, data = m.geom_type, m.geom_dataid
    near = {b for a, b in pairs if kinds[a] == plane and kinds[b] == mesh}
    hulls = {int(data[g]): _hull(m, int(data[g])) for g in near}
    used = [int(data[g]) if kinds[g] == hfield else -1 for g in range(m.ngeom)]
    return {
        "hulls": tuple(hulls[int(data[g])] if g in near else None for g in range(m.ngeom)),
        "heights": tuple(array(_heights(m, k)) for k in range(m.nhfield)),
        "fields": tuple(used),
    }


_KINDS = ("PLANE", "MESH", "HFIELD")


def _hull(m: mujoco.MjModel, k: int) -> Hull | None:
    """Return the convex hull of a mesh, or None if the file has no hull of it."""
    start, count = m.mesh_polyadr[k], m.mesh_polynum[k]
    if not count:
        return None
    vertices = m.mesh_vert[m.mesh_vertadr[k] :][: m.mesh_vertnum[k]].astype(np.float64)
    faces = []
    for face in range(start, start + count):
        first = m.mesh_polyvertadr[face]
        faces.append(m.mesh_polyvert[first : first + m.mesh_polyvertnum[face]].tolist())
    kept = sorted({v for face in faces for v in face})
    local = {v: i for i, v in enumerate(kept)}
    return Hull.from_faces(
        vertices[kept],
        [[local[v] for v in face] for face in faces],
        np.asarray(m.mesh_polynormal[start : start + count], np.float64),
    )


def _heights(m: mujoco.MjModel, k: int) -> np.ndarray:
    """Return the heights of a field, m, row by row along y."""
    rows, columns = int(m.hfield_nrow[k]), int(m.hfield_ncol[k])
    first = m.hfield_adr[k]
    data = m.hfield_data[first : first + rows * columns].reshape(rows, columns)
    return data.astype(np.float64) * m.hfield_size[k, 2]
