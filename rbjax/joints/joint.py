"""What a kind of joint is: the links that it is made of, and how each of them moves.

A *link* is one velocity coordinate. Its frame is turned so that its axis is z:

    S = [turns z; slides z]

A joint is a chain of links in one place (a cylindrical joint: a slide, then a hinge), or a *node*:
several links that share one frame, the first of which carries the whole motion, while the others
stand still against it and bring their axes (a ball).
"""

from __future__ import annotations

import abc
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar

from rbjax.joints.joint_motion import JointMotion, Placed
from rbjax.lanes import Lane, Vec3
from rbjax.spatial import Motion


class LinkKind(abc.ABC):
    """How one link moves.

    `turns` and `slides` are its axis where that is constant in the link's frame (`straight`) and
    the same for all joints of the kind (`alike`); otherwise `axis` gives it. `still`: the link does
    not move against the link before it, which carries the motion.
    """

    turns: ClassVar[float] = 0.0
    slides: ClassVar[float] = 0.0
    straight: ClassVar[bool] = True
    alike: ClassVar[bool] = True
    still: ClassVar[bool] = False

    def axis(self, numbers: Sequence[Lane]) -> Motion:
        """S in the link's axes, where it is constant; `numbers` are the joint's own."""
        return Motion(Vec3(0.0, 0.0, self.turns), Vec3(0.0, 0.0, self.slides))

    @abc.abstractmethod
    def motion(self, q: Sequence[Lane], v: Sequence[Lane], link: Placed) -> JointMotion:
        """The motion of the link, from the coordinates that its `LinkForm` names."""


@dataclass(frozen=True)
class LinkForm:
    """One link of a joint: its kind, the coordinates that its motion reads, and where it sits."""

    kind: LinkKind
    #: among the joint's coordinates
    q: range
    v: range
    #: which axis of the joint's frame is the link's z: 0, 1, 2
    axis: int = 2
    #: where among the joint's own numbers an axis begins that is the link's z instead, or None
    own_axis: int | None = None
    #: the links of the joint that share one frame
    node: range = range(1)
    #: whether the coordinate counts from the model's reference
    from_reference: bool = True
    #: whether the motion turns the body's frame, not the link's
    turns_body: bool = False


class Joint:
    """A kind of joint. Register an instance with `rbjax.joints.register`.

    Class attributes: name; links; nq; `numbers`, its own numbers beside an axis and an anchor, by
    name with their default values (a number, or several); `aligned`, whether its frame is turned so
    that the model's axis is its z; `on_world`, whether its coordinates count from the world's
    frame.
    """

    name: ClassVar[str]
    links: tuple[LinkForm, ...]
    nq: int
    numbers: ClassVar[Mapping[str, float | tuple[float, ...]]] = MappingProxyType({})
    #: whether the last coordinates are a unit quaternion, with an angular velocity in body axes
    quaternion: ClassVar[bool] = False
    aligned: ClassVar[bool] = True
    #: whether the joint frame is the shortest rotation of z to the axis, as x and y matter
    shortest_turn: ClassVar[bool] = False
    on_world: ClassVar[bool] = False

    @property
    def nv(self) -> int:
        """Velocity coordinates."""
        return len(self.links)

    @property
    def defaults(self) -> tuple[float, ...]:
        """The default values of its own numbers, one after the other."""
        values = (x if isinstance(x, tuple) else (x,) for x in self.numbers.values())
        return tuple(float(a) for x in values for a in x)


class Chain(Joint):
    """A joint of links that each have a coordinate and a frame of their own."""

    def __init__(self, *links: tuple[LinkKind, int], **form: bool):
        """links: each link's kind, and which axis of the joint's frame is its z."""
        one = [range(n, n + 1) for n in range(len(links))]
        self.links = tuple(
            LinkForm(kind, at, at, axis, node=at, **form)
            for (kind, axis), at in zip(links, one, strict=True)
        )
        self.nq = len(links)
