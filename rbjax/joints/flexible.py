"""Flexible links: links with n coordinates of their own, and the frames that they carry.

A flexible link has a base frame, which is fixed to the parent of its joint, and frames at which
children, sites and forces act. Relative to the base frame, frame k has

    pose T_k(q),   twist S_k(q) q',   acceleration S_k q'' + bias_k,   S_k = [S_k1 ... S_kn]

The kinetic energy of a link is a function of the twist V of its base and of q':

    T = sum_k (X_k V + S_k q').I_k (X_k V + S_k q') / 2 + V.I V / 2 + V.C q' + q'.m q' / 2

The first term are rigid inertias I_k at frames, such as the sections of a beam. The others are the
`LinkInertia` of a body whose deformation is a sum of modes (Jain & Rodriguez, JGCD 15(6), 1992).
Each coordinate is a dof with S = 0 in the base frame. The frames are links without a dof.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax

from rbjax.joints.joint import DofKind, DofSpec, Joint, JointMotion, NodeMotion, Placed
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
            bias: S_k' q' with classical accelerations [w'; r''], in the axes of the frame.
            own: rigid inertia of the frame; None for none.
        """
        zero = Motion.zero()
        own = RigidInertia.zero() if own is None else own
        return cls(
            pose.R, pose.p, zero, twist.ang, 0.0, twist.lin, bias, zero, tuple(axes), own
        )  # fmt: skip

    def inertia(self, dof: Placed) -> RigidInertia:
        return dof.inertia + self.own


class LinkInertia(NamedTuple):
    """The inertia of a flexible link over the twist of its base and its coordinates.

    Fields:
        rigid: inertia I of the deformed link about its base frame.
        coupling: C, the momentum [angular; linear] for a unit rate of each coordinate.
        mass: m, rows of the modal mass matrix (n, n).
        force: wrench on the base of velocities, without w x J w and w x (w x h) of `rigid`.
        forces: generalized forces of velocities, one for each coordinate.
    """

    rigid: RigidInertia
    coupling: tuple[Force, ...]
    mass: tuple[tuple[Lane, ...], ...]
    force: Force
    forces: tuple[Lane, ...]


class Flexible(Joint):
    """A flexible link of n coordinates. Subclasses define `name`, `coordinates`, `count`, `frames`.

    Class or instance attributes:
        coordinates: n.
        count: the number of frames.

    The base frame has the axes of the body. Bodies that are attached to a frame move with it.
    """

    aligned = False
    coordinates: int
    count: int

    def __init__(self) -> None:
        every = range(self.coordinates)
        self.dofs = tuple(
            DofSpec(CoordinateDof(self, k), every, every, node=every, from_reference=False)
            for k in every
        )

    def frames(
        self, q: Sequence[Lane], v: Sequence[Lane], params: Sequence[Lane]
    ) -> list[FrameMotion]:
        """Compute the motion of each frame, relative to the base frame.

        v is structurally zero (all literals) if the velocities are not needed.
        """
        raise NotImplementedError(f"{type(self).__name__} needs frames(q, v, params)")

    def inertia(
        self, q: Sequence[Lane], v: Sequence[Lane], w: Vec3, params: Sequence[Lane]
    ) -> LinkInertia | None:
        """Compute the inertia over base and coordinates, in addition to the inertias of frames.

        w is the angular velocity of the base frame in its own axes.
        """
        return None


class CoordinateDof(DofKind):
    """Coordinate k of a flexible link. It does not move the base frame."""

    def __init__(self, joint: Flexible, k: int):
        self.joint, self.k = joint, k

    def axis(self, params: Sequence[Lane]) -> Motion:
        return Motion.zero()

    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        none = Vec3.zero()
        return JointMotion(Mat3.identity(), none, Motion.zero(), none, v[self.k])
