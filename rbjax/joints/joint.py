"""Joints: chains of degrees of freedom (dofs), and the motion of each dof.

The frame of a dof is rotated so that the axis of the dof is z:

    S = [angular z; linear z]

A joint is a chain of dofs (a cylindrical joint is a slide, then a hinge), or a *node*: several dofs
that share one frame. The first dof of a node has the whole motion. All further dofs are rigid to it
and contribute only their axes. A ball is a node of three dofs.
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Protocol

import jax

from rbjax.lanes import Lane, Mat3, Vec3
from rbjax.spatial import Force, Motion, RigidInertia, Transform

#: one lane for each coordinate of a flexible link that is not eliminated yet; () at other links
Block = tuple[Lane, ...]


class Placed(Protocol):
    """The constants of a dof that determine its motion."""

    @property
    def R(self) -> Mat3: ...

    @property
    def p(self) -> Vec3: ...

    @property
    def reference(self) -> Lane: ...

    @property
    def params(self) -> Sequence[Lane]: ...

    @property
    def inertia(self) -> RigidInertia: ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class JointMotion:
    """The motion of a dof whose axis S is constant in its frame.

    Fields:
        J: rotation of the frame relative to its orientation at zero displacement.
        at: displacement of the frame, m, in its axes at zero displacement.
        S: axis, in the axes of the frame.
        rate: angular velocity of the frame relative to its parent, in the axes of the frame.
        qd: speed along S.
    """

    J: Mat3
    at: Vec3
    S: Motion
    rate: Vec3
    qd: Lane

    def inertia(self, dof: Placed) -> RigidInertia:
        """Return the inertia of the link about its origin, in its axes."""
        return dof.inertia

    @property
    def frame_axes(self) -> tuple[Motion, ...] | None:
        """The axis of a frame of a flexible link for each coordinate; None at other links."""
        return None

    @property
    def coordinate_of(self) -> Any:
        """The flexible link of which the dof is a coordinate, or None."""
        return None

    def accelerate(self, qdd: Lane, block: Block) -> tuple[Motion, Block]:
        """Compute the acceleration of the frame relative to its parent from joint accelerations.

        qdd: the acceleration of the dof.
        block: accelerations of the coordinates of a flexible link, from its first to its last dof.
            Return the block for the children.
        """
        return self.S * qdd, ()

    def project(self, f: Force, block: Block) -> tuple[Lane, Block]:
        """Compute the generalized force of the dof from the force f on the link.

        block: generalized forces of the coordinates of a flexible link, from its frames. Return the
            block for the parent.
        """
        return self.S.dot(f), ()

    def virtual(self, rate: Lane, block: Block) -> tuple[Motion, Block]:
        """Compute the virtual twist of the frame relative to its parent from virtual rates.

        rate: the virtual rate of the dof. block: see `accelerate`.
        """
        return self.accelerate(rate, block)

    def virtual_power(self, w: Vec3, a: Motion, V: Motion) -> Lane:
        """Compute the virtual power of inertial forces that `inertia` and `link_inertia` do not
        contain, from the angular velocity, acceleration and virtual twist of the parent."""
        return 0.0

    def own_momentum(self, V: Motion) -> tuple[RigidInertia, Force]:
        """Return the inertia that the joint adds to the bodies of the link, and its momentum.

        V is the twist of the link. Both are in its axes, at its origin.
        """
        return RigidInertia.zero(), Force.zero()

    def link_inertia(self, w: Vec3) -> Any:
        """Return the `LinkInertia` of a flexible link at its last coordinate, otherwise None.

        w is the angular velocity of its base frame in its own axes.
        """
        return None

    def transform(self, dof: Placed) -> Transform:
        """Return the pose of the frame in its parent."""
        return Transform(dof.R @ self.J, dof.p + dof.R @ self.at)

    @property
    def twist(self) -> Motion:
        """The spatial velocity of the frame relative to its parent, in the axes of the frame."""
        return Motion(self.rate, (self.S * self.qd).lin)

    @property
    def bias(self) -> Motion:
        """The acceleration [w'; r''] relative to the parent at qdd = 0, in the frame's axes."""
        return Motion.zero()

    @property
    def S_rate(self) -> Motion:
        """The time derivative of S, in the axes of the frame."""
        return Motion.zero()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NodeMotion(JointMotion):
    """The motion of a dof whose axis S depends on q.

    Fields: `lin` is the linear part of `twist`, `drift` is `bias`, and `turn` is `S_rate`.
    """

    lin: Vec3
    drift: Motion
    turn: Motion

    @classmethod
    def of(cls, motion: JointMotion) -> NodeMotion:
        """Convert a joint motion to a `NodeMotion`."""
        if isinstance(motion, cls):
            return motion
        none = Motion.zero()
        lin = motion.twist.lin
        return cls(motion.J, motion.at, motion.S, motion.rate, motion.qd, lin, none, none)

    @property
    def twist(self) -> Motion:
        return Motion(self.rate, self.lin)

    @property
    def bias(self) -> Motion:
        return self.drift

    @property
    def S_rate(self) -> Motion:
        return self.turn


class PosedJoint:
    """A joint motion with a precomputed pose of its frame."""

    def __init__(self, motion: JointMotion, dof: Placed):
        self._motion, self.pose = motion, motion.transform(dof)

    @property
    def recomputed(self) -> Any:
        """The lanes that loops compute again instead of storing them: the pose, and the axes of a
        frame of a flexible link."""
        return self.pose, self._motion.frame_axes

    def transform(self, dof: Placed) -> Transform:
        """Return the pose of the frame in its parent."""
        return self.pose

    def __getattr__(self, name: str) -> Any:
        return getattr(self._motion, name)


class DofKind(abc.ABC):
    """A kind of motion of one dof.

    Class attributes:
        angular, linear: the z components of S, if S is the same for all joints of the kind.
        constant_axis: True if S is constant in the frame.
        shared_axis: True if S is the same for all joints of the kind; otherwise override `axis`.
        rigid_to_previous: True if the frame does not move relative to the frame of the previous
            dof, which has the motion of both.
    """

    angular: ClassVar[float] = 0.0
    linear: ClassVar[float] = 0.0
    constant_axis: ClassVar[bool] = True
    shared_axis: ClassVar[bool] = True
    rigid_to_previous: ClassVar[bool] = False

    def axis(self, params: Sequence[Lane]) -> Motion:
        """Return S in the frame's axes, if it is constant, from the parameters of the joint."""
        return Motion(Vec3(0.0, 0.0, self.angular), Vec3(0.0, 0.0, self.linear))

    @abc.abstractmethod
    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        """Compute the motion from the coordinates q and v that the `DofSpec` lists."""


@dataclass(frozen=True)
class DofSpec:
    """One dof of a joint: its kind, the coordinates that determine its motion, and its frame.

    Fields:
        kind: the kind of motion.
        q, v: indices among the coordinates of the joint.
        axis: the axis of the joint's frame that is the z axis of the dof: 0, 1, 2.
        own_axis: the index of three parameters of the joint that are the z axis of the dof instead,
            or None.
        node: the dofs of the joint that share the frame of this dof.
        from_reference: whether the displacement is the coordinate minus the model's reference.
        turns_body: whether the motion rotates the body's frame instead of the frame of the dof.
    """

    kind: DofKind
    q: range
    v: range
    axis: int = 2
    own_axis: int | None = None
    node: range = range(1)
    from_reference: bool = True
    turns_body: bool = False


class Joint:
    """A kind of joint. Register an instance with `rbjax.joints.register`.

    Class attributes:
        name: the name of the kind.
        dofs: a `DofSpec` for each velocity coordinate.
        params: name -> default value of each parameter other than axis and anchor.
        quaternion: True if the last four coordinates of q are a unit quaternion, and the last three
            of v its angular velocity in body axes.
        aligned: True if the joint's frame is rotated so that its z axis is the axis of the model.
        shortest_turn: True if this rotation must be the shortest one, which determines x and y.
        on_world: True if the coordinates are relative to the world.
    """

    name: str
    dofs: tuple[DofSpec, ...]
    params: Mapping[str, float | tuple[float, ...]] = MappingProxyType({})
    quaternion: ClassVar[bool] = False
    aligned: ClassVar[bool] = True
    shortest_turn: ClassVar[bool] = False
    on_world: ClassVar[bool] = False

    @property
    def nv(self) -> int:
        """The number of velocity coordinates."""
        return len(self.dofs)

    @property
    def nq(self) -> int:
        """The number of configuration coordinates."""
        return len(self.dofs) + self.quaternion

    @property
    def defaults(self) -> tuple[float, ...]:
        """The default values of the parameters, as one flat tuple."""
        values = (x if isinstance(x, tuple) else (x,) for x in self.params.values())
        return tuple(float(a) for x in values for a in x)


def chain(*dofs: tuple[DofKind, int]) -> tuple[DofSpec, ...]:
    """Return the specs of dofs that each have their own coordinate and frame.

    Each argument is a pair: the kind of a dof, and the axis (0, 1, 2) of the joint that is its z.
    """
    own = [range(n, n + 1) for n in range(len(dofs))]
    return tuple(
        DofSpec(kind, at, at, axis, node=at) for (kind, axis), at in zip(dofs, own, strict=True)
    )
