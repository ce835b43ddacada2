"""The geoms and links that can touch, at a state."""

from __future__ import annotations

from typing import NamedTuple

import jax

from rbjax.contact.geometry.shapes import Shape
from rbjax.lanes import Mat3, Vec3


class World(NamedTuple):
    """The geoms and links that can touch, about the common origin.

    Fields:
        geoms: (n, 15) rotation, position and size of each geom.
        twists: (n, 6) twist of each link; the last one is the world.
        poses: (n, 12) rotation and position of each link, if rows are in the axes of their links.
        heights: of the height fields, as `Geoms.heights`.
        responses: (2, n, 21) sum of S_j S_j^T / m_j over the dofs between each pair of links, with
            the diagonal m of the mass matrix, and with the one that the solver uses, if they
            differ.
    """

    geoms: jax.Array
    twists: jax.Array
    poses: jax.Array | None = None
    heights: tuple[jax.Array, ...] = ()
    responses: jax.Array | None = None


def shape_of(row: jax.Array) -> Shape:
    """Return the shape of a row of `World.geoms`."""
    lanes = [row[k] for k in range(15)]
    return Shape(Vec3(*lanes[9:12]), Mat3(*lanes[:9]), Vec3(*lanes[12:]))
