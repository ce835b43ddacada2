"""Slide (prismatic joint): moves along z by q."""

from __future__ import annotations

from collections.abc import Sequence

from rbjax.joints.joint import Chain, LinkKind
from rbjax.joints.joint_motion import JointMotion, Placed
from rbjax.lanes import Lane, Mat3, Vec3, sub
from rbjax.spatial import Motion

S = Motion(Vec3.zero(), Vec3(0.0, 0.0, 1.0))


class SlideLink(LinkKind):
    """Moves along z."""

    slides = 1.0

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], link: Placed) -> JointMotion:
        at = Vec3(0.0, 0.0, sub(q[0], link.reference))
        return JointMotion(Mat3.identity(), at, S, Vec3.zero(), v[0])


SLIDE = SlideLink()


class Slide(Chain):
    """A shift along the axis, q in m."""

    name = "slide"

    def __init__(self) -> None:
        super().__init__((SLIDE, 2))
