"""The part of a robot that belongs to the program: tree, joint kinds, names. Hashable, no numbers.

The arithmetic runs over *links*, one for each velocity coordinate: a hinge is one, a ball three
(`rbjax.joints`). Each link's frame is turned so that its axis is z. Bodies without joints are
merged into the last link of the body that carries them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

from rbjax.joints import DofKind, DofSpec, Joint, kind

WORLD = -1


class Span(NamedTuple):
    """Where a joint's coordinates are in q and v: those that simply add, then an attitude's."""

    q: slice
    v: slice
    #: a unit quaternion in q and its angular velocity in v, or None
    attitude: tuple[slice, slice] | None


def spans(top: Any) -> Iterator[Span]:
    """The span of each joint of a topology."""
    for joint, at, dat in zip(top.joints, top.joint_q, top.joint_v, strict=True):
        straight = joint.nv - 3 if joint.quaternion else joint.nv
        q, v = slice(at, at + straight), slice(dat, dat + straight)
        turning = slice(q.stop, at + joint.nq), slice(v.stop, dat + joint.nv)
        yield Span(q, v, turning if joint.quaternion else None)


@dataclass(frozen=True)
class Dof:
    """One velocity coordinate: where it sits and how it moves."""

    body: int
    joint: int
    parent: int  # link, or WORLD
    first_on_body: bool
    spec: DofSpec
    #: the coordinates in q and in v that its motion reads
    q: range
    v: range
    #: the links that share its frame
    node: range

    @property
    def kind(self) -> DofKind:
        """How it moves."""
        return self.spec.kind


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
    #: what the kinds are, by identity: a name that is registered again is another program
    joints: tuple[Joint, ...] = ()

    def __post_init__(self) -> None:
        if not self.joints:
            object.__setattr__(self, "joints", tuple(kind(name) for name in self.joint_kinds))

    def __reduce__(self) -> tuple:
        """Kinds are found again by their names where a topology is unpickled."""
        given = [getattr(self, f.name) for f in dataclasses.fields(self) if f.name != "joints"]
        return Topology, tuple(given)

    @property
    def nb(self) -> int:
        return len(self.body_parents)

    @cached_property
    def nq(self) -> int:
        return sum(joint.nq for joint in self.joints)

    @cached_property
    def nv(self) -> int:
        return sum(joint.nv for joint in self.joints)

    @cached_property
    def joint_q(self) -> tuple[int, ...]:
        """Where each joint's coordinates start in q."""
        return _starts([joint.nq for joint in self.joints])

    @cached_property
    def joint_v(self) -> tuple[int, ...]:
        """Where each joint's coordinates start in v."""
        return _starts([joint.nv for joint in self.joints])

    @cached_property
    def quaternion_starts(self) -> tuple[int, ...]:
        """Where each unit quaternion starts in q."""
        return tuple(span.attitude[0].start for span in spans(self) if span.attitude)

    @cached_property
    def turn_starts(self) -> tuple[int, ...]:
        """Where each attitude's angular velocity starts in v, beside `quaternion_starts`."""
        return tuple(span.attitude[1].start for span in spans(self) if span.attitude)

    @cached_property
    def dofs(self) -> tuple[Dof, ...]:
        """The dofs, in the order of v; parents come before children."""
        last = self.last_links
        out: list[Dof] = []
        for j, (joint, body) in enumerate(zip(self.joints, self.joint_bodies, strict=True)):
            first = j == 0 or self.joint_bodies[j - 1] != body
            q, v = self.joint_q[j], self.joint_v[j]
            for n, spec in enumerate(joint.dofs):
                start = first and n == 0
                parent = len(out) - 1
                if start:
                    carrier = self._carrier(self.body_parents[body])
                    parent = WORLD if carrier == WORLD else last[carrier]
                at = _moved(spec.q, q), _moved(spec.v, v), _moved(spec.node, v)
                out.append(Dof(body, j, parent, start, spec, *at))
        return tuple(out)

    @cached_property
    def last_links(self) -> dict[int, int]:
        """The last link of each body that has joints."""
        return {
            body: self.joint_v[j] + self.joints[j].nv - 1
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
        return tuple(link.parent for link in self.dofs)

    @cached_property
    def ancestors(self) -> tuple[tuple[int, ...], ...]:
        """For each link the links from the root to itself."""
        out: list[tuple[int, ...]] = []
        for i, parent in enumerate(self.parents):
            out.append((*(out[parent] if parent != WORLD else ()), i))
        return tuple(out)

    @cached_property
    def constant_axes(self) -> bool:
        """Whether the axis of each dof is constant in the frame of the dof."""
        return all(dof.kind.constant_axis for dof in self.dofs)


def _moved(some: range, start: int) -> range:
    return range(some.start + start, some.stop + start)


def _starts(sizes: list[int]) -> tuple[int, ...]:
    return tuple(accumulate([0, *sizes]))[:-1]
