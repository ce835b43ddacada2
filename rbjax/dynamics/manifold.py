"""Plus and minus on the configuration manifold.

    position + dq;  hinge, slide: q + dq;  attitude: q exp(dq / 2), dq in body axes
The tangent is that of v: integrate(q, v dt) is motion at constant v for a time dt.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import algorithm
from rbjax.lanes import Lane, sub
from rbjax.model import JOINT_SIZES, Model, Topology
from rbjax.rotations import quaternion


def integrate_lanes(top: Topology, q: list[Lane], dq: list[Lane]) -> list[Lane]:
    """q + dq on lanes; quaternions come out of unit length."""
    out: list[Lane] = []
    for kind, at, dat in zip(top.joint_kinds, top.joint_q, top.joint_v, strict=True):
        nq, nv = JOINT_SIZES[kind]
        straight = nv if kind in ("hinge", "slide") else nv - 3
        out += [q[at + k] + dq[dat + k] for k in range(straight)]
        if nq != straight:
            turn = q[at + straight : at + nq]
            out += quaternion.turned(turn, dq[dat + straight : dat + nv])
    return out


def difference_lanes(top: Topology, q0: list[Lane], q1: list[Lane]) -> list[Lane]:
    """q1 - q0 on lanes, for quaternions of any length."""
    out: list[Lane] = []
    for kind, at in zip(top.joint_kinds, top.joint_q, strict=True):
        nq, nv = JOINT_SIZES[kind]
        straight = nv if kind in ("hinge", "slide") else nv - 3
        out += [sub(q1[at + k], q0[at + k]) for k in range(straight)]
        if nq != straight:
            (aw, ax, ay, az), (w, x, y, z) = (p[at + straight : at + nq] for p in (q0, q1))
            turn = [
                aw * w + ax * x + ay * y + az * z,
                aw * x - ax * w - ay * z + az * y,
                aw * y + ax * z - ay * w - az * x,
                aw * z - ax * y + ay * x - az * w,
            ]
            out += quaternion.log_lanes(turn)
    return out


@algorithm("q", "dq")
def integrate(model: Model, q: jax.Array, dq: jax.Array) -> jax.Array:
    """The configuration (nq,) reached from q by the tangent vector dq (nv,): q + dq.

    Attitudes: q exp(dq / 2), dq in body axes; the result has unit quaternions.

    Args:
        model: the robot.
        q: (nq,) configuration.
        dq: (nv,) m and rad, in the coordinates of v.

    Source: Sola, Deray & Atchuthan, *A micro Lie theory*, 2018, eq. 25.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("free_body")
        >>> state = model.default_state()
        >>> rb.integrate(model, state.q, 0.1 + state.v).shape
        (7,)
    """
    if not model.nq:
        return q
    return jnp.stack(integrate_lanes(model.topology, list(q), list(dq)))


@algorithm("q0", "q1")
def difference(model: Model, q0: jax.Array, q1: jax.Array) -> jax.Array:
    """The tangent vector (nv,) that takes q0 to q1, with integrate(q0, dq) = q1: q1 - q0.

    Args:
        model: the robot.
        q0: (nq,) configuration.
        q1: (nq,) configuration.

    Source: Sola, Deray & Atchuthan, *A micro Lie theory*, 2018, eq. 26.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("free_body")
        >>> q = model.default_state().q
        >>> rb.difference(model, q, q).shape
        (6,)
    """
    top, out = model.topology, [jnp.zeros(0, q0.dtype)]
    for kind, at in zip(top.joint_kinds, top.joint_q, strict=True):
        nq, nv = JOINT_SIZES[kind]
        straight = nv if kind in ("hinge", "slide") else nv - 3
        out.append(q1[at : at + straight] - q0[at : at + straight])
        if nq != straight:
            a, b = (x[at + straight : at + nq] for x in (q0, q1))
            turn = quaternion.multiply(quaternion.conjugate(a), b)
            out.append(quaternion.log(quaternion.normalize(turn)))
    return jnp.concatenate(out)
