"""Twists and wrenches at points, sums of wrenches, power (Olguin Diaz, 6.1).

If only the reference point changes, by r from O to P, with the same axes:

    v_P = v_O + omega x r,    n_P = n_O - r x f
"""

from __future__ import annotations

import jax

from rbjax.arguments import ArrayLike
from rbjax.lanes import Vec3
from rbjax.rotations import screws
from rbjax.rotations.arguments import entries, stacked, takes
from rbjax.rotations.screws import Screw
from rbjax.spatial.vectors import Force, Motion


@takes(V="twist", point="vector")
def twist_at(V: ArrayLike, point: ArrayLike) -> jax.Array:
    """Compute the twist (omega, v + omega x r) (..., 6) at a point from the twist V at the origin.

    Args:
        V: (..., 6), twists, rad/s, then m/s.
        point: (..., 3), from the origin, m.

    Returns:
        (..., 6), rad/s, then m/s.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import twist_at
        >>> twist_at([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0]).tolist()
        [0.0, 0.0, 1.0, 0.0, 2.0, 0.0]
    """
    m, r = Motion.from_lanes(entries(V)), Vec3(*entries(point))
    return stacked(Motion(m.ang, m.lin + m.ang.cross(r)))


@takes(F="twist", point="vector")
def wrench_at(F: ArrayLike, point: ArrayLike) -> jax.Array:
    """Compute the wrench (n - r x f, f) (..., 6) at a point from the wrench F at the origin.

    Args:
        F: (..., 6), wrenches, N m, then N.
        point: (..., 3), from the origin, m.

    Returns:
        (..., 6), N m, then N.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import wrench_at
        >>> wrench_at([0.0, 0.0, 2.0, 0.0, 1.0, 0.0], [2.0, 0.0, 0.0]).tolist()
        [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    """
    f, r = Force.from_lanes(entries(F)), Vec3(*entries(point))
    return stacked(Force(f.ang - r.cross(f.lin), f.lin))


@takes(f="vector", point="vector")
def force_at(f: ArrayLike, point: ArrayLike) -> jax.Array:
    """Compute the wrench (r x f, f) (..., 6) at the origin of a force f (..., 3) at a point.

    Args:
        f: (..., 3), forces, N.
        point: (..., 3), from the origin, m.

    Returns:
        (..., 6), N m, then N.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import force_at
        >>> force_at([0.0, 1.0, 0.0], [2.0, 0.0, 0.0]).tolist()
        [0.0, 0.0, 2.0, 0.0, 1.0, 0.0]
    """
    f_, r = Vec3(*entries(f)), Vec3(*entries(point))
    return stacked(Force(r.cross(f_), f_))


@takes(wrenches="twist", points="vector", about="vector")
def merge_wrenches(wrenches: ArrayLike, points: ArrayLike, about: ArrayLike) -> jax.Array:
    """Sum wrenches (..., n, 6) at different points (..., n, 3) to one wrench at the point `about`.

    All are in the same axes.

    Args:
        wrenches: (..., n, 6), N m, then N.
        points: (..., n, 3), m.
        about: (..., 3), m.

    Returns:
        (..., 6), N m, then N.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import merge_wrenches
        >>> couple = [[0.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, -1.0, 0.0]]
        >>> merge_wrenches(couple, [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [7.0, 7.0, 7.0]).tolist()
        [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    """
    return wrench_at(wrenches, about[..., None, :] - points).sum(-2)


@takes(F="twist", V="twist")
def power(F: ArrayLike, V: ArrayLike) -> jax.Array:
    """Compute the power n . omega + f . v (...) of a wrench and a twist at one point in one frame.

    Args:
        F: (..., 6), wrenches, N m, then N.
        V: (..., 6), twists, rad/s, then m/s.

    Returns:
        (...), W.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import power
        >>> float(power([1.0, 0.0, 0.0, 0.0, 2.0, 0.0], [3.0, 0.0, 0.0, 0.0, 4.0, 0.0]))
        11.0
    """
    return Motion.from_lanes(entries(V)).dot(Force.from_lanes(entries(F)))


@takes(F="twist")
def central_axis(F: ArrayLike) -> Screw:
    """Compute the central axis of a wrench: a force along a line and a couple about it (Poinsot).

    `axis` and `point` define the line, `pitch` is couple / force, and `magnitude` is the force. For
    a pure couple the pitch is infinite, and `magnitude` is the couple.

    Args:
        F: (..., 6), wrenches, N m, then N.

    Returns:
        `Screw`, with the pitch in m and the magnitude in N, or N m for a couple.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import central_axis
        >>> s = central_axis([0.0, 0.0, 2.0, 0.0, 1.0, 0.0])
        >>> s.axis.tolist(), s.point.tolist(), float(s.magnitude)
        ([0.0, 1.0, 0.0], [2.0, 0.0, 0.0], 1.0)
    """
    f = Force.from_lanes(entries(F))
    return screws.from_twist(stacked([*f.lin, *f.ang]))
