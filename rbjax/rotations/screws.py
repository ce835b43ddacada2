"""Screws: a twist as a rotation about a line and a translation along it (Lynch & Park, 3.3.2).

A twist V = (omega, v) of magnitude theta and pitch h about the line through r along the unit
vector s is omega = theta s, v = theta (r x s + h s). A pure translation has infinite pitch, the
magnitude |v|, and the axis v / |v|.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.display import displayed
from rbjax.lanes import Vec3, safe_sqrt
from rbjax.rotations.arguments import entries, stacked, takes

__all__ = [
    "Screw", "from_twist", "to_twist",
]  # fmt: skip


@displayed
class Screw(NamedTuple):
    """A screw: a line with a pitch and a magnitude.

    Fields:
        axis: (..., 3), unit vectors along the lines, no unit.
        point: (..., 3), points of the lines, m.
        pitch: (...), m/rad; infinite for a pure translation.
        magnitude: (...), of the angular part; of the linear part if the pitch is infinite.
    """

    axis: jax.Array
    point: jax.Array
    pitch: jax.Array
    magnitude: jax.Array


@takes(twist="twist")
def from_twist(twist: jax.Array) -> Screw:
    """Compute the screw of a twist (..., 6), with the `point` of its line nearest the origin.

    The zero twist has the axis z and the magnitude 0.

    Args:
        twist: (..., 6), angular first: rad/s, then m/s.

    Returns:
        A `Screw`.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations.screws import from_twist
        >>> s = from_twist([0.0, 0.0, 2.0, 0.0, -2.0, 6.0])
        >>> s.axis.tolist(), abs(s.point).tolist(), float(s.pitch), float(s.magnitude)
        ([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], 3.0, 2.0)
    """
    parts = entries(twist)
    omega, v = Vec3(*parts[:3]), Vec3(*parts[3:])
    square, straight = omega.dot(omega), v.dot(v)
    turns, slides = square > 0, straight > 0
    safe = jnp.where(turns, square, 1.0)
    magnitude = jnp.where(turns, safe_sqrt(square), safe_sqrt(straight))
    shrink = 1 / jnp.where(turns | slides, magnitude, 1.0)
    still = (0.0, 0.0, 1.0)
    axis = [
        jnp.where(turns, a, jnp.where(slides, b, c)) * shrink
        for a, b, c in zip(omega, v, still, strict=True)
    ]
    axis = [jnp.where(turns | slides, a, c) for a, c in zip(axis, still, strict=True)]
    point = [jnp.where(turns, a / safe, 0.0) for a in omega.cross(v)]
    pitch = jnp.where(turns, omega.dot(v) / safe, jnp.inf)
    return Screw(stacked(axis), stacked(point), pitch, magnitude)


@takes(axis="vector", point="vector", pitch="scalar_or_infinite", magnitude="scalar")
def to_twist(axis: jax.Array, point: jax.Array, pitch: jax.Array, magnitude: jax.Array):
    """Compute the twist (..., 6) of a screw. An infinite pitch means a pure translation.

    Args:
        axis: (..., 3), unit vectors, no unit.
        point: (..., 3), points of the lines, m.
        pitch: (...), m/rad; may be infinite.
        magnitude: (...), rad/s, or m/s for an infinite pitch.

    Returns:
        (..., 6), angular first: rad/s, then m/s.

    Raises:
        InputError: another shape, or values that are not finite, except the pitch.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.rotations.screws import to_twist
        >>> to_twist([0.0, 0.0, 1.0], [1.0, 0.0, 0.0], jnp.inf, 2.0).tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, 2.0]
    """
    s, r = Vec3(*entries(axis)), Vec3(*entries(point))
    turns = jnp.isfinite(pitch)
    h = jnp.where(turns, pitch, 0.0)
    turning = [*s, *(r.cross(s) + h * s)]
    sliding = [0.0, 0.0, 0.0, *s]
    both = zip(turning, sliding, strict=True)
    return stacked([magnitude * jnp.where(turns, a, b) for a, b in both])
