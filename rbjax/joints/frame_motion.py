"""The motion of a frame of a flexible link (flexible.py)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import jax

from rbjax.joints.joint import Block, NodeMotion, Placed
from rbjax.lanes import Lane, Mat3, Vec3
from rbjax.spatial import Force, Motion, RigidInertia, Transform


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class FrameMotion(NodeMotion):
    """The motion of a frame of a flexible link, relative to the base frame of the link.

    Fields:
        axes: S_kj of each coordinate j, in the axes of the frame.
        own: rigid inertia that moves with the frame, in its axes, about its origin.
    """

    axes: tuple[Motion, ...]
    own: RigidInertia

    @classmethod
    def at_pose(
        cls,
        pose: Transform,
        axes: Sequence[Motion],
        twist: Motion,
        bias: Motion,
        own: RigidInertia | None = None,
    ) -> FrameMotion:
        """Create the motion of a frame.

        Args:
            pose: pose of the frame in the base frame.
            axes: S_kj, in the axes of the frame.
            twist: S_k q', in the axes of the frame.
            bias: classical acceleration [w'; r''] of the frame relative to the base at q'' = 0, in
                the axes of the frame.
            own: rigid inertia of the frame; None for none.
        """
        zero = Motion.zero()
        own = RigidInertia.zero() if own is None else own
        return cls(
            pose.R, pose.p, zero, twist.ang, 0.0, twist.lin, bias, zero, tuple(axes), own
        )  # fmt: skip

    @property
    def frame_axes(self) -> tuple[Motion, ...]:
        return self.axes

    def inertia(self, dof: Placed) -> RigidInertia:
        return dof.inertia + self.own

    def own_momentum(self, V: Motion) -> tuple[RigidInertia, Force]:
        return self.own, self.own(V)

    def accelerate(self, qdd: Lane, block: Block) -> tuple[Motion, Block]:
        a = Motion.zero()
        for S, rate in zip(self.axes, block, strict=True):
            a = a + S * rate
        return a, ()

    def project(self, f: Force, block: Block) -> tuple[Lane, Block]:
        return 0.0, tuple(S.dot(f) for S in self.axes)


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class VirtualFrame(FrameMotion):
    """The motion of a frame along given accelerations and virtual rates of the coordinates.

    `bias` includes S_k q''. There are no axes.

    Fields:
        virtual_twist: S_k l for virtual rates l, in the axes of the frame.
        distributed: what `DistributedPower` needs, at the first frame of a link; else None.
    """

    virtual_twist: Motion
    distributed: DistributedPower | None = None

    @classmethod
    def in_axes(
        cls,
        R: Mat3,
        r: Vec3,
        twist: Motion,
        acceleration: Motion,
        virtual: Motion,
        distributed: DistributedPower | None = None,
    ) -> VirtualFrame:
        """Create the motion of a frame from [w; r'], [w'; r''] and virtual twist in base axes."""
        zero, E = Motion.zero(), R.T
        twist, acceleration, virtual = (
            Motion(E @ x.ang, E @ x.lin) for x in (twist, acceleration, virtual)
        )
        own = RigidInertia.zero()
        fixed = R, r, zero, twist.ang, 0.0, twist.lin
        return cls(*fixed, acceleration, zero, (), own, virtual, distributed)

    @classmethod
    def along(cls, frame: FrameMotion, a: Sequence[Lane], rates: Sequence[Lane]) -> VirtualFrame:
        """Convert the motion of a frame with axes. a: q''; rates: virtual rates l."""
        acceleration, virtual = frame.bias, Motion.zero()
        for S, x, y in zip(frame.axes, a, rates, strict=True):
            acceleration, virtual = acceleration + S * x, virtual + S * y
        fixed = frame.J, frame.at, frame.S, frame.rate, frame.qd, frame.lin
        return cls(*fixed, acceleration, frame.turn, (), frame.own, virtual)

    def accelerate(self, qdd: Lane, block: Block) -> tuple[Motion, Block]:
        return Motion.zero(), ()

    def virtual(self, rate: Lane, block: Block) -> tuple[Motion, Block]:
        return self.virtual_twist, ()

    def virtual_power(self, w: Vec3, a: Motion, V: Motion) -> Lane:
        return 0.0 if self.distributed is None else self.distributed.power(w, a, V)


class DistributedPower(Protocol):
    """The virtual power of the inertial forces of a link, without the inertias of its frames."""

    def power(self, w: Vec3, a: Motion, V: Motion) -> Lane:
        """Compute the power from the motion of the base frame, in its axes.
        w: angular velocity. a: classical acceleration. V: virtual twist."""
