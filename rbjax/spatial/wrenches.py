"""Twists and wrenches at other points, sums of wrenches, and power (Olguin Diaz, ch. 4-5).

The axes stay the same and the point of reference changes. omega and f are the same at all points,
and

    v_P = v_O + omega x r,    n_P = n_O - r x f        r from O to P
"""

from __future__ import annotations

import jax

from rbjax.lanes import Vec3
from rbjax.rotations import screws
from rbjax.rotations.screws import Screw
from rbjax.spatial.arguments import entries, force, motion, stacked, takes
from rbjax.spatial.vectors import Force, Motion


@takes(V="twist", point="vector")
def twist_at(V: jax.Array, point: jax.Array) -> jax.Array:
    """The twist (..., 6) at a point from V at the origin: (omega, v + omega x r).

    >>> twist_at([0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [2.0, 0.0, 0.0]).tolist()
    [0.0, 0.0, 1.0, 0.0, 2.0, 0.0]
    """
    m, r = motion(V), Vec3(*entries(point))
    return stacked(Motion(m.ang, m.lin + m.ang.cross(r)))


@takes(F="twist", point="vector")
def wrench_at(F: jax.Array, point: jax.Array) -> jax.Array:
    """The wrench (..., 6) at a point from F at the origin: (n - r x f, f).

    >>> wrench_at([0.0, 0.0, 2.0, 0.0, 1.0, 0.0], [2.0, 0.0, 0.0]).tolist()
    [0.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    """
    f, r = force(F), Vec3(*entries(point))
    return stacked(Force(f.ang - r.cross(f.lin), f.lin))


@takes(f="vector", point="vector")
def force_at(f: jax.Array, point: jax.Array) -> jax.Array:
    """The wrench (..., 6) at the origin of a force f (..., 3) that acts at a point: (r x f, f).

    >>> force_at([0.0, 1.0, 0.0], [2.0, 0.0, 0.0]).tolist()
    [0.0, 0.0, 2.0, 0.0, 1.0, 0.0]
    """
    f_, r = Vec3(*entries(f)), Vec3(*entries(point))
    return stacked(Force(r.cross(f_), f_))


@takes(wrenches="twist", points="vector", about="vector")
def merge_wrenches(wrenches: jax.Array, points: jax.Array, about: jax.Array) -> jax.Array:
    """The sum (..., 6), at the point `about`, of wrenches (..., n, 6) that are each given at their
    own point (..., n, 3), all in the same axes.

    >>> couple = [[0.0, 0.0, 0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 0.0, -1.0, 0.0]]
    >>> merge_wrenches(couple, [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]], [7.0, 7.0, 7.0]).tolist()
    [0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    """
    return wrench_at(wrenches, about[..., None, :] - points).sum(-2)


@takes(F="twist", V="twist")
def power(F: jax.Array, V: jax.Array) -> jax.Array:
    """n . omega + f . v (...) of a wrench and a twist at the same point in the same axes.

    >>> float(power([1.0, 0.0, 0.0, 0.0, 2.0, 0.0], [3.0, 0.0, 0.0, 0.0, 4.0, 0.0]))
    11.0
    """
    return motion(V).dot(force(F))


@takes(F="twist")
def central_axis(F: jax.Array) -> Screw:
    """Poinsot: any wrench is a force along a line and a couple about it.

    `axis` and `point` are of the line, `pitch` = couple / force, `magnitude` is that of the force.
    An infinite pitch means a pure couple with this magnitude.

    >>> s = central_axis([0.0, 0.0, 2.0, 0.0, 1.0, 0.0])
    >>> s.axis.tolist(), s.point.tolist(), float(s.magnitude)
    ([0.0, 1.0, 0.0], [2.0, 0.0, 0.0], 1.0)
    """
    f = force(F)
    return screws.from_twist(stacked([*f.lin, *f.ang]))
