"""Convex hulls of meshes, as constants of a program."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np


@dataclass(frozen=True, eq=False)
class Hull:
    """The convex hull of a mesh in the frame of its geom. It is hashable, as a static field."""

    vertices: np.ndarray  # (n, 3) m
    normals: np.ndarray  # (n, f, 3) outward unit normals of the faces at each vertex
    #: (n, f, 4) indices of up to four corners of each of these faces, in order around the face
    #: from the vertex; -1 for none
    corners: np.ndarray

    @classmethod
    def from_faces(cls, vertices: np.ndarray, faces: list[list[int]], normals: np.ndarray) -> Hull:
        """Make a hull from its faces, each a convex polygon with its outward normal."""
        at: list[list[tuple[np.ndarray, list[int]]]] = [[] for _ in vertices]
        for face, normal in zip(faces, normals, strict=True):
            for i in range(len(face)):
                turned = face[i:] + face[:i]
                chosen = [turned[k] for k in _spread(vertices[turned])]
                at[face[i]].append((normal, chosen + [-1] * (4 - len(chosen))))
        most = max(len(x) for x in at)
        padded = [x + x[-1:] * (most - len(x)) for x in at]
        return cls(
            np.asarray(vertices, np.float64),
            np.array([[normal for normal, _ in x] for x in padded]),
            np.array([[corners for _, corners in x] for x in padded], np.int32),
        )

    @property
    def radius(self) -> float:
        """Distance of the farthest vertex from the origin of the geom, m."""
        return float(np.sqrt((self.vertices**2).sum(-1).max()))

    @cached_property
    def _key(self) -> tuple:
        arrays = (self.vertices, self.normals, self.corners)
        return tuple(x.tobytes() for x in arrays), self.corners.shape

    @cached_property
    def _hash(self) -> int:
        return hash(self._key)

    def __hash__(self) -> int:
        return self._hash

    def __eq__(self, other: Any) -> bool:
        return self is other or (isinstance(other, Hull) and self._key == other._key)


def _spread(polygon: np.ndarray) -> list[int]:
    """Choose up to four corners of a convex polygon, with the first one, that span a large area.

    Corners advance along the polygon as long as the area of the quadrilateral grows.
    """
    n = len(polygon)
    if n <= 4:
        return list(range(n))
    chosen, moved = [0, 1, 2, 3], True
    while moved:
        moved = False
        for k in (3, 2, 1):
            following = chosen[k] + 1
            if following >= (chosen[k + 1] if k < 3 else n):
                continue
            larger = [*chosen[:k], following, *chosen[k + 1 :]]
            if _area(polygon[larger]) > _area(polygon[chosen]):
                chosen, moved = larger, True
    return chosen


def _area(polygon: np.ndarray) -> float:
    """Return twice the area of a plane polygon."""
    following = np.roll(polygon, -1, 0)
    return float(np.linalg.norm(np.cross(polygon, following).sum(0)))
