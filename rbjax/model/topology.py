"""What of a robot is part of the program: its tree, joint kinds, names. Hashable, never a number.

The arithmetic runs over *links*, one for each velocity coordinate. A hinge or slide is one link. A
ball is three links in the same place whose axes are x, y, z of the body, the first of which carries
the whole rotation; a free joint is three slides along the world's axes and a ball. Each link's
frame is turned so that its joint axis is z. Bodies without joints are merged into the last link
of the body that carries them.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

WORLD = -1
#: configuration and velocity coordinates of each joint kind
JOINT_SIZES = {"free": (7, 6), "ball": (4, 3), "slide": (1, 1), "hinge": (1, 1)}


class Span(NamedTuple):
    """Where a joint's coordinates are in q and v: those that simply add, then an attitude's."""

    q: slice
    v: slice
    #: a unit quaternion in q and its angular velocity in v, or None
    attitude: tuple[slice, slice] | None


def spans(top: Any) -> Iterator[Span]:
    """The span of each joint of a topology."""
    for kind, at, dat in zip(top.joint_kinds, top.joint_q, top.joint_v, strict=True):
        nq, nv = JOINT_SIZES[kind]
        straight = nv if nq == nv else nv - 3
        q, v = slice(at, at + straight), slice(dat, dat + straight)
        turning = slice(q.stop, at + nq), slice(v.stop, dat + nv)
        yield Span(q, v, None if nq == nv else turning)


@dataclass(frozen=True)
class Link:
    """One velocity coordinate: where it sits and how it moves."""

    body: int
    joint: int
    parent: int  # link, or WORLD
    kind: str  # "hinge" or "slide"
    first_on_body: bool
    #: where its joint coordinate starts in q; None where a ball's first link has moved already
    q: Any
    #: 0, 1, 2 for the x, y, z link of a ball or of a free joint's slides, else None
    part: int | None
    #: the first link of a ball, which carries the rotation
    quaternion: bool


@dataclass(frozen=True)
class Topology:
    """The static side of a model: tuples only."""

    body_parents: tuple[int, ...]
    joint_kinds: tuple[str, ...]
    joint_bodies: tuple[int, ...]
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    actuator_names: tuple[str, ...] = ()
    site_names: tuple[str, ...] = ()
    site_bodies: tuple[int, ...] = ()
    keyframe_names: tuple[str, ...] = ()

    @property
    def nb(self) -> int:
        return len(self.body_parents)

    @cached_property
    def nq(self) -> int:
        return sum(JOINT_SIZES[k][0] for k in self.joint_kinds)

    @cached_property
    def nv(self) -> int:
        return sum(JOINT_SIZES[k][1] for k in self.joint_kinds)

    @cached_property
    def joint_q(self) -> tuple[int, ...]:
        """Where each joint's coordinates start in q."""
        return _starts([JOINT_SIZES[k][0] for k in self.joint_kinds])

    @cached_property
    def joint_v(self) -> tuple[int, ...]:
        """Where each joint's coordinates start in v."""
        return _starts([JOINT_SIZES[k][1] for k in self.joint_kinds])

    @cached_property
    def quaternion_starts(self) -> tuple[int, ...]:
        """Where each unit quaternion starts in q."""
        return tuple(span.attitude[0].start for span in spans(self) if span.attitude)

    @cached_property
    def turn_starts(self) -> tuple[int, ...]:
        """Where each attitude's angular velocity starts in v, beside `quaternion_starts`."""
        return tuple(span.attitude[1].start for span in spans(self) if span.attitude)

    @cached_property
    def links(self) -> tuple[Link, ...]:
        """The links, in the order of v; parents come before children."""
        last = self.last_links
        out: list[Link] = []
        for j, (kind, body) in enumerate(zip(self.joint_kinds, self.joint_bodies, strict=True)):
            first = j == 0 or self.joint_bodies[j - 1] != body
            q = self.joint_q[j]
            for n in range(JOINT_SIZES[kind][1]):
                slide = kind == "slide" or (kind == "free" and n < 3)
                turn = kind in ("ball", "free") and not slide
                start = first and n == 0
                parent = len(out) - 1
                if start:
                    carrier = self._carrier(self.body_parents[body])
                    parent = WORLD if carrier == WORLD else last[carrier]
                out.append(
                    Link(
                        body=body,
                        joint=j,
                        parent=parent,
                        kind="slide" if slide else "hinge",
                        first_on_body=start,
                        q=None if turn and n % 3 else q + n,
                        part=n % 3 if kind in ("ball", "free") else None,
                        quaternion=turn and n % 3 == 0,
                    )
                )
        return tuple(out)

    @cached_property
    def last_links(self) -> dict[int, int]:
        """The last link of each body that has joints."""
        return {
            body: self.joint_v[j] + JOINT_SIZES[self.joint_kinds[j]][1] - 1
            for j, body in enumerate(self.joint_bodies)
        }

    def _carrier(self, body: int) -> int:
        """The nearest body, itself or an ancestor, that has joints; or WORLD."""
        while body != WORLD and body not in self.last_links:
            body = self.body_parents[body]
        return body

    @cached_property
    def carriers(self) -> tuple[int, ...]:
        """For each body the body that it is welded to (itself, if it has joints), or WORLD."""
        return tuple(self._carrier(b) for b in range(self.nb))

    @cached_property
    def body_links(self) -> tuple[int, ...]:
        """For each body the link that it moves with, or WORLD."""
        return tuple(WORLD if c == WORLD else self.last_links[c] for c in self.carriers)

    @cached_property
    def weld_depth(self) -> tuple[int, ...]:
        """For each body the number of welds between it and its carrier (or the world)."""
        out: list[int] = []
        for b, parent in enumerate(self.body_parents):
            welded = b not in self.last_links
            out.append((1 + (out[parent] if parent != WORLD else 0)) if welded else 0)
        return tuple(out)

    @cached_property
    def parents(self) -> tuple[int, ...]:
        """The parent link of each link, or WORLD."""
        return tuple(link.parent for link in self.links)

    @cached_property
    def ancestors(self) -> tuple[tuple[int, ...], ...]:
        """For each link the links from the root to itself."""
        out: list[tuple[int, ...]] = []
        for i, parent in enumerate(self.parents):
            out.append((*(out[parent] if parent != WORLD else ()), i))
        return tuple(out)

    def last_of_ball(self, i: int) -> int:
        """The last link of the ball that link i belongs to; else the link itself."""
        link = self.links[i]
        return i if link.part is None or link.kind == "slide" else i + 2 - link.part


def _starts(sizes: list[int]) -> tuple[int, ...]:
    return tuple(accumulate([0, *sizes]))[:-1]
