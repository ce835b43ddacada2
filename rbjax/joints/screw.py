"""Screw (helical joint): turns about z by q and moves along it by pitch q."""

from __future__ import annotations

from collections.abc import Sequence
from types import MappingProxyType

from rbjax.joints.joint import Chain, LinkKind
from rbjax.joints.joint_motion import JointMotion, Placed
from rbjax.lanes import Lane, Vec3, mul, rotation_z, sincos, sub
from rbjax.spatial import Motion


class ScrewLink(LinkKind):
    """Turns about z and slides along it, `numbers[0]` metres a radian."""

    alike = False

    def axis(self, numbers: Sequence[Lane]) -> Motion:
        return Motion(Vec3(0.0, 0.0, 1.0), Vec3(0.0, 0.0, numbers[0]))

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], link: Placed) -> JointMotion:
        angle = sub(q[0], link.reference)
        at = Vec3(0.0, 0.0, mul(link.numbers[0], angle))
        J, rate = rotation_z(*sincos(angle)), Vec3(0.0, 0.0, v[0])
        return JointMotion(J, at, self.axis(link.numbers), rate, v[0])


class Screw(Chain):
    """A turn about the axis with a shift along it, q in rad; pitch in m/rad."""

    name = "screw"
    numbers = MappingProxyType({"pitch": 0.0})

    def __init__(self) -> None:
        super().__init__((ScrewLink(), 2))
