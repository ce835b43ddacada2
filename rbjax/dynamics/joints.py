"""How each link moves against its parent, from q and v.

A hinge turns about z by q, a slide moves along z by q. The first link of a ball carries the whole
rotation of its quaternion and the whole angular velocity; the other two stand still against it and
only bring their axis. For all three the joint's share of the bias acceleration is w x S qd with w
the final angular velocity, because the axes are fixed in the body (Featherstone, 4.5).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, Mat3, Vec3, quaternion_matrix, rotation_z, sincos, sub
from rbjax.model import Link, LinkConstants, Prepared, Topology
from rbjax.model.cells import stacked
from rbjax.spatial import Motion, Transform

_CYCLE = Mat3(0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0)  # z to x, x to y, y to z
_HINGE = Motion(Vec3(0.0, 0.0, 1.0), Vec3.zero())
_SLIDE = Motion(Vec3.zero(), Vec3(0.0, 0.0, 1.0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class JointMotion:
    """J turns the link against its parent, `slide` moves it along z; S is its axis.

    `rate` is the angular velocity that the joint adds, `qd` the speed along S.
    """

    J: Mat3
    slide: Lane
    S: Motion
    rate: Vec3
    qd: Lane

    def transform(self, link: LinkConstants) -> Transform:
        """The pose of the link in its parent."""
        return Transform(link.R @ self.J, link.p + link.R.columns[2] * self.slide)


class PosedJoint(JointMotion):
    """A joint motion that knows the link's pose already."""

    pose: Transform

    def __init__(self, motion: JointMotion, link: LinkConstants):
        super().__init__(motion.J, motion.slide, motion.S, motion.rate, motion.qd)
        object.__setattr__(self, "pose", motion.transform(link))

    def transform(self, link: LinkConstants) -> Transform:
        return self.pose


def own_axis(link: Link) -> Motion:
    """S in the link's own axes."""
    return _SLIDE if link.kind == "slide" else _HINGE


def joint_lanes(
    link: Link, constants: LinkConstants, q: list[Lane], v: list[Lane], i: int
) -> JointMotion:
    """The motion of one link, for the unrolled driver."""
    qd = v[i]
    if link.kind == "slide":
        at = sub(q[link.q], constants.reference)
        return JointMotion(Mat3.identity(), at, _SLIDE, Vec3.zero(), qd)
    if link.quaternion:
        J = quaternion_matrix(*q[link.q : link.q + 4]) @ _CYCLE
        return JointMotion(J, 0.0, _HINGE, Vec3(v[i + 1], v[i + 2], v[i]), qd)
    if link.q is None:
        return JointMotion(Mat3.identity(), 0.0, _HINGE, Vec3.zero(), qd)
    c, s = sincos(sub(q[link.q], constants.reference))
    return turning(c, s, qd)


def joint_columns(
    top: Topology, prepared: Prepared, q: jax.Array, v: jax.Array | None, start: int = 0
) -> tuple[Callable[..., JointMotion], list[Lane]]:
    """The motions of the links from `start` on, for the rolled driver: a function, and its columns.

    The function makes a `JointMotion` of the columns (nv - start, ...), or of one link's lanes.
    """
    links = top.links[start:]
    batch = (1,) * (q.ndim - 1)

    def mask(flags):
        return np.array(list(flags), bool).reshape(-1, *batch)

    hinge = mask(link.kind == "hinge" for link in links)
    own = mask(link.kind == "hinge" and link.part is None for link in links)
    places = np.array([0 if link.q is None else link.q for link in links])
    reference = prepared.columns.reference[start:].reshape(-1, *batch)
    at = q[places] - stacked(reference, q.dtype)
    v = None if v is None else v[start:]
    qd = 0.0 if v is None else v
    if own.all():
        return turning, [*sincos(at), qd]
    J = rotation_z(*sincos(jnp.where(own, at, 0.0)))
    rate = Vec3.zero() if v is None else Vec3(0.0, 0.0, jnp.where(own, v, 0.0))
    first = np.array([i for i, link in enumerate(links) if link.quaternion], int)
    if len(first):
        quaternion = (q[places[first] + k] for k in range(4))
        turned = quaternion_matrix(*quaternion) @ _CYCLE
        J = Mat3(*(_insert(a, first, b, at) for a, b in zip(J, turned, strict=True)))
        if v is not None:
            extra = (v[first + 1], v[first + 2], v[first])
            rate = Vec3(*(_insert(a, first, b, v) for a, b in zip(rate, extra, strict=True)))
    S = _HINGE
    if not hinge.all():
        turns = jnp.asarray(hinge, q.dtype)
        S = Motion(Vec3(0.0, 0.0, turns), Vec3(0.0, 0.0, 1 - turns))
    slide = 0.0 if hinge.all() else jnp.where(hinge, 0.0, at)
    leaves, treedef = jax.tree.flatten(JointMotion(J, slide, S, rate, qd))
    return lambda *lanes: jax.tree.unflatten(treedef, lanes), leaves


def turning(c: Lane, s: Lane, qd: Lane) -> JointMotion:
    """The motion of a hinge that is not part of a ball: cosine, sine and speed."""
    return JointMotion(rotation_z(c, s), 0.0, _HINGE, Vec3(0.0, 0.0, qd), qd)


def _insert(column: Lane, rows: np.ndarray, values: jax.Array, like: jax.Array) -> jax.Array:
    return jnp.broadcast_to(jnp.asarray(column, like.dtype), like.shape).at[rows].set(values)
