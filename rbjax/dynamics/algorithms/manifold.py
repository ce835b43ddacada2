"""Plus and minus on the configuration manifold.

    position + dq;  hinge, slide: q + dq;  attitude: q exp(dq / 2), dq in body axes
Tangent vectors have the coordinates of v: integrate(q, v dt) is motion at constant v for a time dt.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.lanes import Lane, Vec3, fusion_barrier, horner, sub
from rbjax.model import Model, joint_slices
from rbjax.rotations import quaternion
from rbjax.rotations.coefficients import stumpff


def integrate_lanes(top: Any, q: list[Lane], dq: list[Lane]) -> list[Lane]:
    """Compute the configuration q + dq on lanes. The resulting quaternions have unit length."""
    out: list[Lane] = []
    for span in joint_slices(top):
        out += [a + b for a, b in zip(q[span.q], dq[span.v], strict=True)]
        if span.attitude:
            turn, by = span.attitude
            out += quaternion.turned(q[turn], dq[by])
    return out


def rate_lanes(top: Any, u: list[Lane], v: list[Lane]) -> list[Lane]:
    """Compute the rate u' of the increment u of q + u at the velocity v, on lanes.

    It is v, except for attitudes q exp(u)

        u' = J_r(u)^-1 w = w + u x w / 2 + e u x (u x w),   e = 1/12 + x/720 + ..., x = |u|^2

    The series of e ends at x^5. It is exact to order 13 in u, with an error of 1e-5 w at |u| = 2.
    Beyond |u| = 3 e is constant, so that stages of a long step stay finite (e has a pole at 2 pi).
    The full function is `rotations.inverse_jacobian_coefficient`, which needs sines.
    """

    def coefficients(x: Lane) -> tuple[Lane, Lane]:
        near = x if isinstance(x, float | int) else jnp.minimum(x, _FARTHEST)
        return 0.5, horner(_TURN, near)

    return _with_attitudes(top, u, v, coefficients)


_FARTHEST = 9.0  # largest t^2 of the series below
#: |B_2k| / (2 k)!, the coefficients of (1 - (t/2) cot(t/2)) / t^2 as a series in t^2
_TURN = (1 / 12, 1 / 720, 1 / 30240, 1 / 1209600, 1 / 47900160, 691 / 1307674368000)


def velocity_lanes(top: Any, u: list[Lane], du: list[Lane]) -> list[Lane]:
    """Compute the velocity v of q + u at the rate u' = du, on lanes.

    It is du, except for attitudes q exp(u)

        w = J_r(u) u' = u' - a u x u' + b u x (u x u'),
        a = (1 - cos |u|) / |u|^2,   b = (|u| - sin |u|) / |u|^3

    J_r^T is J_r(-u).
    """

    def coefficients(x: Lane) -> tuple[Lane, Lane]:
        a, b = stumpff(x, 2, 3)
        return -a, b

    return _with_attitudes(top, u, du, coefficients)


def _with_attitudes(
    top: Any, u: list[Lane], v: list[Lane], coefficients: Callable[[Any], tuple[Lane, Lane]]
) -> list[Lane]:
    """Replace the angular velocities w in v by w + a u x w + b u x (u x w).
    `coefficients` returns a and b from |u|^2."""
    out: list[Lane] = []
    for span in joint_slices(top):
        out += v[span.v]
        if span.attitude:
            by = span.attitude[1]
            turn, w = Vec3(*u[by]), Vec3(*v[by])
            once = turn.cross(w)
            a, b = coefficients(turn.dot(turn))
            out.extend(w + once * a + turn.cross(once) * b)
    return out


def retract(model: Model, q: jax.Array, dq: jax.Array) -> jax.Array:
    """Compute `integrate` of checked arrays (nq, ...) and (nv, ...), with any batch axes last."""
    if not model.nv:
        return q
    return jnp.stack(fusion_barrier(integrate_lanes(model.topology, list(q), list(dq))))


def increment_rate(model: Model, u: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the rate u' (nv, ...) of the increment u of q + u at the velocity v."""
    if not model.topology.turn_starts:
        return v
    return jnp.stack(fusion_barrier(rate_lanes(model.topology, list(u), list(v))))


def difference_lanes(top: Any, q0: list[Lane], q1: list[Lane]) -> list[Lane]:
    """Compute the tangent vector q1 - q0 on lanes, for quaternions of any nonzero length."""
    out: list[Lane] = []
    for span in joint_slices(top):
        out += [sub(b, a) for a, b in zip(q0[span.q], q1[span.q], strict=True)]
        if span.attitude:
            (aw, ax, ay, az), (w, x, y, z) = (p[span.attitude[0]] for p in (q0, q1))
            turn = [
                aw * w + ax * x + ay * y + az * z,
                aw * x - ax * w - ay * z + az * y,
                aw * y + ax * z - ay * w - az * x,
                aw * z - ax * y + ay * x - az * w,
            ]
            out += quaternion.log_lanes(turn)
    return out


@algorithm("q", "dq")
def integrate(model: Model, q: ArrayLike, dq: ArrayLike) -> jax.Array:
    """Compute the configuration q + dq (nq,) from a configuration and a tangent vector dq (nv,).

    For attitudes it is q exp(dq / 2), with dq in body axes. Resulting quaternions have unit length.

    Args:
        model: the robot.
        q: (nq,) configuration.
        dq: (nv,) m and rad, in the coordinates of v.

    Returns:
        (nq,), m, rad and unit quaternions.

    Source: Sola, Deray & Atchuthan, *A micro Lie theory*, 2018, eq. 25.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("free_body")
        >>> state = model.default_state()
        >>> rb.integrate(model, state.q, 0.1 + state.v).shape
        (7,)
    """
    return retract(model, q, dq)


@algorithm("q0", "q1")
def difference(model: Model, q0: ArrayLike, q1: ArrayLike) -> jax.Array:
    """Compute the tangent vector dq = q1 - q0 (nv,), with integrate(q0, dq) = q1.

    Args:
        model: the robot.
        q0: (nq,) configuration.
        q1: (nq,) configuration.

    Returns:
        (nv,), m and rad.

    Source: Sola, Deray & Atchuthan, *A micro Lie theory*, 2018, eq. 26.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("free_body")
        >>> q = model.default_state().q
        >>> rb.difference(model, q, q).shape
        (6,)
    """
    if not model.nv:
        return jnp.zeros(0, q0.dtype)
    return jnp.stack(fusion_barrier(difference_lanes(model.topology, list(q0), list(q1))))
