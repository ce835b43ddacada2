"""Joints: chains of degrees of freedom (dofs), and the motion of each.

The frame of a dof is rotated so that the axis of the dof is z:

    S = [angular z; linear z]

A joint is a chain of dofs (a cylindrical joint is a slide, then a hinge), or a *node*: several dofs
that share one frame. The first dof of a node has the whole motion; the others are rigid to it and
contribute their axes (a ball).
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, Protocol

import jax

from rbjax.lanes import Lane, Mat3, Vec3
from rbjax.spatial import Motion, Transform


class Placed(Protocol):
    """The constants of a dof that its motion reads."""

    @property
    def R(self) -> Mat3: ...

    @property
    def p(self) -> Vec3: ...

    @property
    def reference(self) -> Lane: ...

    @property
    def params(self) -> Sequence[Lane]: ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class JointMotion:
    """The motion of a dof whose axis S is constant in its frame.

    Fields:
        J: rotation of the frame in its parent, beyond the constant one.
        at: displacement of the frame.
        S: axis.
        rate: angular velocity that the joint adds, in the axes of the frame.
        qd: speed along S.
    """

    J: Mat3
    at: Vec3
    S: Motion
    rate: Vec3
    qd: Lane

    def transform(self, dof: Placed) -> Transform:
        """The pose of the frame in its parent."""
        return Transform(dof.R @ self.J, dof.p + dof.R @ self.at)

    @property
    def twist(self) -> Motion:
        """The velocity that the joint adds, in the axes of the frame."""
        return Motion(self.rate, (self.S * self.qd).lin)

    @property
    def bias(self) -> Motion:
        """The acceleration relative to the parent at qdd = 0: [w'; r''], in the frame's axes."""
        return Motion.zero()

    @property
    def S_rate(self) -> Motion:
        """S' in the axes of the frame."""
        return Motion.zero()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NodeMotion(JointMotion):
    """The motion of a dof whose axis S depends on q: `lin`, `drift` and `turn` are the linear part
    of `twist`, `bias` and `S_rate`."""

    lin: Vec3
    drift: Motion
    turn: Motion

    @classmethod
    def of(cls, motion: JointMotion) -> NodeMotion:
        """The same motion in this form."""
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
    """A joint motion with the pose of its frame, computed once."""

    def __init__(self, motion: JointMotion, dof: Placed):
        self._motion, self.pose = motion, motion.transform(dof)

    def transform(self, dof: Placed) -> Transform:
        """The pose of the frame in its parent."""
        return self.pose

    def __getattr__(self, name: str) -> Any:
        return getattr(self._motion, name)


class DofKind(abc.ABC):
    """How one dof moves.

    Class attributes:
        angular, linear: the axis, if it is constant in the frame and the same for all joints.
        constant_axis: whether S is constant in the frame.
        shared_axis: whether S is the same for all joints of the kind; else `axis` returns it.
        rigid_to_previous: whether the frame does not move relative to that of the previous dof,
            which has the motion of both.
    """

    angular: ClassVar[float] = 0.0
    linear: ClassVar[float] = 0.0
    constant_axis: ClassVar[bool] = True
    shared_axis: ClassVar[bool] = True
    rigid_to_previous: ClassVar[bool] = False

    def axis(self, params: Sequence[Lane]) -> Motion:
        """S in the frame's axes, if it is constant; `params` are the parameters of the joint."""
        return Motion(Vec3(0.0, 0.0, self.angular), Vec3(0.0, 0.0, self.linear))

    @abc.abstractmethod
    def motion(self, q: Sequence[Lane], v: Sequence[Lane], dof: Placed) -> JointMotion:
        """The motion, from the coordinates that the `DofSpec` lists."""


@dataclass(frozen=True)
class DofSpec:
    """One dof of a joint: its kind, the coordinates that its motion reads, and its frame."""

    kind: DofKind
    #: among the coordinates of the joint
    q: range
    v: range
    #: the axis of the joint's frame that is z of the dof: 0, 1, 2
    axis: int = 2
    #: the first of three parameters of the joint that are z of the dof instead, or None
    own_axis: int | None = None
    #: the dofs of the joint that share one frame
    node: range = range(1)
    #: whether the coordinate is relative to the model's reference
    from_reference: bool = True
    #: whether the motion rotates the body's frame, not the frame of the dof
    turns_body: bool = False


class Joint:
    """A kind of joint. Register an instance with `rbjax.joints.register`.

    Class attributes:
        name: of the kind.
        dofs: a `DofSpec` for each velocity coordinate.
        params: parameters other than an axis and an anchor: name -> default, a number or several.
        quaternion: whether the last coordinates are a unit quaternion, with an angular velocity in
            body axes.
        aligned: whether the joint's frame is rotated so that the model's axis is its z.
        shortest_turn: whether that rotation is the shortest one, because x and y matter.
        on_world: whether the coordinates are relative to the world.
    """

    name: ClassVar[str]
    dofs: tuple[DofSpec, ...]
    params: ClassVar[Mapping[str, float | tuple[float, ...]]] = MappingProxyType({})
    quaternion: ClassVar[bool] = False
    aligned: ClassVar[bool] = True
    shortest_turn: ClassVar[bool] = False
    on_world: ClassVar[bool] = False

    @property
    def nv(self) -> int:
        """Velocity coordinates."""
        return len(self.dofs)

    @property
    def nq(self) -> int:
        """Configuration coordinates."""
        return len(self.dofs) + self.quaternion

    @property
    def defaults(self) -> tuple[float, ...]:
        """The default values of the parameters, flat."""
        values = (x if isinstance(x, tuple) else (x,) for x in self.params.values())
        return tuple(float(a) for x in values for a in x)


def chain(*dofs: tuple[DofKind, int]) -> tuple[DofSpec, ...]:
    """The dofs of a joint that each have a coordinate and a frame of their own: the kind of each,
    and the axis of the joint's frame that is its z."""
    own = [range(n, n + 1) for n in range(len(dofs))]
    return tuple(
        DofSpec(kind, at, at, axis, node=at) for (kind, axis), at in zip(dofs, own, strict=True)
    )
