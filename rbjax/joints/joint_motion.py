"""How a link moves against its parent at given q and v."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import jax

from rbjax.lanes import Lane, Mat3, Vec3
from rbjax.spatial import Motion, Transform


class Placed(Protocol):
    """What a joint motion needs of a link's constants."""

    @property
    def R(self) -> Mat3: ...

    @property
    def p(self) -> Vec3: ...

    @property
    def reference(self) -> Lane: ...

    @property
    def numbers(self) -> Sequence[Lane]: ...


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class JointMotion:
    """J turns the link against its parent, `at` moves it; S is its axis, qd the speed along S.

    `rate` is the angular velocity that the joint adds, in the link's axes. S is constant there.
    """

    J: Mat3
    at: Vec3
    S: Motion
    rate: Vec3
    qd: Lane

    def transform(self, link: Placed) -> Transform:
        """The pose of the link in its parent."""
        return Transform(link.R @ self.J, link.p + link.R @ self.at)

    @property
    def twist(self) -> Motion:
        """The velocity that the joint adds, in the link's axes."""
        return Motion(self.rate, (self.S * self.qd).lin)

    @property
    def bias(self) -> Motion:
        """The acceleration of the link seen from its parent at qdd = 0: [w'; r''], in the link's
        axes."""
        return Motion.zero()

    @property
    def S_rate(self) -> Motion:
        """S' in the link's axes."""
        return Motion.zero()


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class NodeMotion(JointMotion):
    """The motion of a link whose axis S depends on q. `lin` is the linear velocity that the joint
    adds, `drift` the bias, `turn` the rate of S."""

    lin: Vec3
    drift: Motion
    turn: Motion

    @classmethod
    def of(cls, motion: JointMotion) -> NodeMotion:
        """The same motion, in this form."""
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
    """A joint motion that knows the link's pose already."""

    def __init__(self, motion: JointMotion, link: Placed):
        self._motion, self.pose = motion, motion.transform(link)

    def transform(self, link: Placed) -> Transform:
        """The pose of the link in its parent."""
        return self.pose

    def __getattr__(self, name: str) -> Any:
        return getattr(self._motion, name)
