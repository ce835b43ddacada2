"""The footprint of a robot in the plane, and its clearance from obstacles.

A footprint is a union of discs that covers the robot's outline. A disc is free if the distance of
its centre from obstacles exceeds its radius, which is one lookup in a `DistanceField`.
(Ziegler & Stiller, *Fast collision checking for intelligent vehicle motion planning*, IV 2010)
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import instance, integer, real_array, real_number
from rbjax.errors import InputError
from rbjax.lanes import safe_sqrt
from rbjax.lanes.arrays import largest, smallest
from rbjax.model.record import Record, check_fields, floats
from rbjax.planning.maps.occupancy import DistanceField
from rbjax.rotations.arguments import takes
from rbjax.wheeled import Robot

F = TypeVar("F", bound=Callable[..., Any])


class Footprint(Record):
    """Discs in the robot's frame that cover the robot; x is forward and y to the left.

    Fields:
        centers: (n, 2), m.
        radii: (n,), m.

    Example:
        >>> car = Footprint.rectangle(ahead=0.9, behind=0.3, width=0.6, discs=3)
        >>> car.centers.round(2).tolist(), round(float(car.radii[0]), 4)
        ([[-0.1, 0.0], [0.3, 0.0], [0.7..., 0.0]], 0.3606)
    """

    centers: jax.Array = eqx.field(converter=floats)
    radii: jax.Array = eqx.field(converter=floats)

    def __check_init__(self) -> None:
        check_fields(self)
        n = jnp.shape(self.radii)
        if len(n) != 1 or jnp.shape(self.centers) != (*n, 2) or not n[0]:
            raise InputError(
                f"Footprint: got centers of shape {jnp.shape(self.centers)} and radii of shape {n},"
                " expected (n, 2) and (n,)"
            )

    @property
    def reach(self) -> jax.Array:
        """The largest distance () of a covered point from the frame's origin, m."""
        return largest(safe_sqrt((self.centers**2).sum(-1)) + self.radii)

    @classmethod
    def disc(cls, radius: float) -> Footprint:
        """Make a footprint of one disc around the frame's origin. radius: m."""
        radius = real_number("Footprint.disc", "radius", radius, above=0.0)
        return cls(jnp.zeros((1, 2)), jnp.full(1, radius))

    @classmethod
    def rectangle(cls, ahead: float, behind: float, width: float, discs: int = 4) -> Footprint:
        """Cover the rectangle -behind <= x <= ahead, |y| <= width / 2, in m, by a row of discs. The
        discs extend sqrt((length / discs)^2 + width^2) / 2 - width / 2 beyond its sides."""
        where = "Footprint.rectangle"
        ahead, behind = (real_number(where, *x) for x in (("ahead", ahead), ("behind", behind)))
        real_number(where, "length ahead + behind", ahead + behind, above=0.0)
        width = real_number(where, "width", width, above=0.0)
        discs = integer(where, "discs", discs, least=1)
        each = (ahead + behind) / discs
        x = -behind + each * (np.arange(discs) + 0.5)
        centers = np.column_stack([x, np.zeros(discs)])
        return cls(jnp.asarray(centers), jnp.full(discs, math.hypot(each, width) / 2))

    @classmethod
    def around_wheels(cls, robot: Robot) -> Footprint:
        """Cover the rectangle around the wheels of a robot without trailers.

        Each wheel takes a circle of its radius. A caster takes the circle in which it turns.

        Example:
            >>> import rbjax as rb
            >>> car = rb.wheeled.kinds()["car"].make(wheelbase=2.6, track=1.5, radius=0.3)
            >>> Footprint.around_wheels(car).centers[:, 0].round(2).tolist()
            [0.1, 0.9, 1.7, 2.5]
        """
        where = "Footprint.around_wheels"
        instance(where, "robot", robot, Robot, "rb.wheeled.Robot")
        if len(robot.bodies) > 1:
            raise InputError(
                f"{where}: the robot has trailers, which one footprint cannot cover; give the "
                "robot without them, or a Footprint of all in a line"
            )
        places = np.array([np.asarray(w.position, float) for w in robot.wheels])
        trails = [float(w.trail) * (w.kind == "caster") for w in robot.wheels]
        room = np.array([float(w.radius) for w in robot.wheels]) + trails
        ahead, behind = (places[:, 0] + room).max(), (room - places[:, 0]).max()
        return cls.rectangle(ahead, behind, 2 * (np.abs(places[:, 1]) + room).max())

    @classmethod
    def polygon(cls, vertices: Any, excess: float) -> Footprint:
        """Cover a simple polygon, convex or not, by discs that extend at most `excess` m beyond it.

        vertices: (n, 2), in order, m. The number of discs is about 2 area / excess^2.

        Example:
            >>> wedge = Footprint.polygon([[0, 0], [1, 0], [0, 1]], excess=0.2)
            >>> bool(wedge.reach < 1.21)
            True
        """
        corners = real_array("Footprint.polygon", "vertices", vertices, "an array (n, 2) in m")
        if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 3:
            raise InputError(
                f"Footprint.polygon: vertices have shape {corners.shape}, expected (n, 2), n >= 3"
            )
        excess = real_number("Footprint.polygon", "excess", excess, above=0.0)
        # the squares of a lattice that may touch the polygon
        radius = excess / 2
        side = radius * math.sqrt(2)
        low, high = corners.min(0), corners.max(0)
        n = np.maximum(1, np.ceil((high - low) / side)).astype(int)
        first = (low + high) / 2 - side * (n - 1) / 2
        steps = np.stack(np.meshgrid(*map(np.arange, n), indexing="ij"), -1).reshape(-1, 2)
        centers = first + side * steps
        near = _distances(corners, centers) <= radius
        return cls(jnp.asarray(centers[near]), jnp.full(int(near.sum()), radius))


def _distances(corners: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Compute the distances (k,) of points (k, 2) from a polygon (n, 2); zero inside."""
    a, b = corners, np.roll(corners, -1, 0)
    edge = b - a
    along = ((points[:, None] - a) * edge).sum(-1) / np.maximum((edge * edge).sum(-1), 1e-300)
    nearest = a + np.clip(along, 0, 1)[..., None] * edge
    distance = np.sqrt(((points[:, None] - nearest) ** 2).sum(-1)).min(1)
    # a point is inside if a ray from it along x crosses the edges an odd number of times
    x, y = points[:, :1], points[:, 1:]
    across = (a[:, 1] > y) != (b[:, 1] > y)
    level = np.where(across, edge[:, 1], 1.0)
    crosses = across & (x < a[:, 0] + (y - a[:, 1]) * edge[:, 0] / level)
    return np.where(crosses.sum(1) % 2 == 1, 0.0, distance)


def check_map(where: str, field: Any, footprint: Any) -> None:
    """Raise `InputError` unless the arguments are a distance field and a footprint."""
    made = "rb.planning.DistanceField, of OccupancyGrid.distance_field()"
    instance(where, "field", field, DistanceField, made)
    shape = "rb.planning.Footprint, such as Footprint.rectangle(...)"
    instance(where, "footprint", footprint, Footprint, shape)


def _checks_map(f: F) -> F:
    """Decorate a function to check the field and the footprint before JAX traces it."""

    @functools.wraps(f)
    def call(field: Any, poses: Any, footprint: Any) -> jax.Array:
        check_map(f.__name__, field, footprint)
        return f(field, poses, footprint)

    return cast(F, call)


def disc_centers(poses: jax.Array, footprint: Footprint) -> jax.Array:
    """Compute the centres of discs (..., n, 2) in the world, m."""
    x, y, heading = (poses[..., k, None] for k in range(3))
    c, s = jnp.cos(heading), jnp.sin(heading)
    a, b = footprint.centers[:, 0], footprint.centers[:, 1]
    return jnp.stack([x + c * a - s * b, y + s * a + c * b], -1)


@_checks_map
@takes(poses="planar_pose")
def clearance(field: DistanceField, poses: jax.Array, footprint: Footprint) -> jax.Array:
    """Compute the signed distance of a footprint from obstacles, negative if they overlap.

        min over discs of  d(center) - radius

    It is differentiable.

    Args:
        field: `OccupancyGrid.distance_field()`.
        poses: (..., 3): x and y in m, the heading in rad.
        footprint: `Footprint`.

    Returns:
        (...) in m, by interpolation between cells: within resolution / sqrt(2) of the exact value.

    Raises:
        InputError: wrong types or shapes, poses that are not finite.

    Example:
        >>> from rbjax.planning import OccupancyGrid
        >>> field = OccupancyGrid(np.zeros((20, 20), bool), 0.1).distance_field()
        >>> round(float(clearance(field, [1.0, 0.5, 0.0], Footprint.disc(0.2))), 6)
        0.3
    """
    return smallest(field.at(disc_centers(poses, footprint)) - footprint.radii)


@_checks_map
@takes(poses="planar_pose")
def clear(field: DistanceField, poses: jax.Array, footprint: Footprint) -> jax.Array:
    """Test whether a footprint is certainly free of obstacles.

    The result is true only if every disc is free. It may be false if the exact clearance is less
    than resolution * sqrt(2).

    Args:
        field: `OccupancyGrid.distance_field()`.
        poses: (..., 3), m, m and rad.
        footprint: `Footprint`.

    Returns:
        (...) of bool.

    Raises:
        InputError: wrong types or shapes, poses that are not finite.

    Example:
        >>> from rbjax.planning import OccupancyGrid
        >>> field = OccupancyGrid(np.zeros((20, 20), bool), 0.1).distance_field()
        >>> clear(field, [[1.0, 1.0, 0.0], [1.0, 0.1, 0.0]], Footprint.disc(0.2)).tolist()
        [True, False]
    """
    return (field.below(disc_centers(poses, footprint)) > footprint.radii).all(-1)
