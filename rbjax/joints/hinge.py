"""Hinge (revolute joint): turns about z by q."""

from __future__ import annotations

from collections.abc import Sequence

from rbjax.joints.joint import Chain, LinkKind
from rbjax.joints.joint_motion import JointMotion, Placed
from rbjax.lanes import Lane, Vec3, rotation_z, sincos, sub
from rbjax.spatial import Motion

S = Motion(Vec3(0.0, 0.0, 1.0), Vec3.zero())


def turning(c: Lane, s: Lane, qd: Lane) -> JointMotion:
    """The motion of a hinge, from its cosine, sine and speed."""
    return JointMotion(rotation_z(c, s), Vec3.zero(), S, Vec3(0.0, 0.0, qd), qd)


class HingeLink(LinkKind):
    """Turns about z."""

    turns = 1.0

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], link: Placed) -> JointMotion:
        return turning(*sincos(sub(q[0], link.reference)), v[0])


HINGE = HingeLink()


class Hinge(Chain):
    """A turn about the axis, q in rad."""

    name = "hinge"

    def __init__(self) -> None:
        super().__init__((HINGE, 2))
