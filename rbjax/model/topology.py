"""The static part of a robot: its tree, joint kinds and names, and its isomorphic limbs.

A *dof* is one velocity coordinate: a hinge has one, a ball three (`rbjax.joints`). Each dof moves a
*link*, which may have no mass. The frame of a link is rotated so that the axis of the dof is z.
Recursions run over the links. Bodies without joints are merged into the last link of the body that
carries them.

The frames of a flexible link (`rbjax.joints.Flexible`) are links without a dof. Their indices
follow those of the dofs.

"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any, NamedTuple

from rbjax.joints import DofKind, DofSpec, Flexible, Joint, kind
from rbjax.joints.registry import dump_kind, load_kind

WORLD = -1


class JointSlices(NamedTuple):
    """The slices of a joint in q and v.

    q: coordinates whose increments are added.
    v: their velocities.
    attitude: a unit quaternion in q and its angular velocity in v, or None.
    """

    q: slice
    v: slice
    attitude: tuple[slice, slice] | None


def joint_slices(top: Any) -> Iterator[JointSlices]:
    """Yield the span of each joint of a topology."""
    for joint, at, dat in zip(top.joints, top.joint_q, top.joint_v, strict=True):
        added = joint.nv - 3 if joint.quaternion else joint.nv
        q, v = slice(at, at + added), slice(dat, dat + added)
        attitude = slice(q.stop, at + joint.nq), slice(v.stop, dat + joint.nv)
        yield JointSlices(q, v, attitude if joint.quaternion else None)


@dataclass(frozen=True)
class Dof:
    """A velocity coordinate: its place in the tree and its kind."""

    body: int
    joint: int
    parent: int  # link, or WORLD
    first_on_body: bool
    spec: DofSpec
    #: the coordinates in q and in v that determine its motion
    q: range
    v: range
    #: the dofs that share its frame
    node: range

    @property
    def kind(self) -> DofKind:
        """The kind of motion of the dof."""
        return self.spec.kind


@dataclass(frozen=True)
class Topology:
    """The static part of a model, as hashable tuples."""

    body_parents: tuple[int, ...]
    joint_kinds: tuple[str, ...]
    joint_bodies: tuple[int, ...]
    body_names: tuple[str, ...]
    joint_names: tuple[str, ...]
    actuator_names: tuple[str, ...] = ()
    site_names: tuple[str, ...] = ()
    site_bodies: tuple[int, ...] = ()
    keyframe_names: tuple[str, ...] = ()
    #: (body, joint, frame) for each body that is fixed to a frame of a flexible link
    frame_bodies: tuple[tuple[int, int, int], ...] = ()
    #: the joint kinds, compared by identity: registering a name again gives another program
    joints: tuple[Joint, ...] = ()

    def __post_init__(self) -> None:
        if not self.joints:
            object.__setattr__(self, "joints", tuple(kind(name) for name in self.joint_kinds))

    def __reduce__(self) -> tuple:
        """Pickle the joint kinds such that the registered ones are registered again."""
        given = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return _unpickle, (given | {"joints": tuple(map(dump_kind, self.joints))},)

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
        """The index of each joint's first coordinate in q."""
        return _starts([joint.nq for joint in self.joints])

    @cached_property
    def joint_v(self) -> tuple[int, ...]:
        """The index of each joint's first coordinate in v."""
        return _starts([joint.nv for joint in self.joints])

    @cached_property
    def quaternion_starts(self) -> tuple[int, ...]:
        """The index of each unit quaternion in q."""
        return tuple(span.attitude[0].start for span in joint_slices(self) if span.attitude)

    @cached_property
    def turn_starts(self) -> tuple[int, ...]:
        """The index of the angular velocity of each attitude in v."""
        return tuple(span.attitude[1].start for span in joint_slices(self) if span.attitude)

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
                if n == 0 and not start:
                    parent = self._link_after(j - 1)
                if start:
                    carrier = self._carrier(self.body_parents[body])
                    parent = WORLD if carrier == WORLD else last[carrier]
                at = _moved(spec.q, q), _moved(spec.v, v), _moved(spec.node, v)
                out.append(Dof(body, j, parent, start, spec, *at))
        return tuple(out)

    @cached_property
    def links(self) -> tuple[Dof, ...]:
        """The dofs, and then the frames of flexible links."""
        return (*self.dofs, *self.frames)

    @cached_property
    def frames(self) -> tuple[Dof, ...]:
        """The frames of flexible links, joint by joint, as links without a dof."""
        out: list[Dof] = []
        for j, joint in enumerate(self.joints):
            if isinstance(joint, Flexible):
                q, v = self.joint_q[j], self.joint_v[j]
                for spec in joint.frame_specs:
                    parent, own = v + joint.nv - 1, self.nv + len(out)
                    at = range(q, q + joint.nq), range(v, v + joint.nv), range(own, own + 1)
                    out.append(Dof(self.joint_bodies[j], j, parent, False, spec, *at))
        return tuple(out)

    @cached_property
    def frame_starts(self) -> dict[int, int]:
        """The index of the first frame of each joint with frames."""
        out: dict[int, int] = {}
        for i, frame in enumerate(self.frames):
            out.setdefault(frame.joint, self.nv + i)
        return out

    @cached_property
    def order(self) -> tuple[int, ...]:
        """The links, parents before children."""
        if not self.frames:
            return tuple(range(self.nv))
        return tuple(sorted(range(len(self.links)), key=lambda i: self.ancestors[i]))

    @cached_property
    def last_links(self) -> dict[int, int]:
        """The link that carries each body with joints, and each body that is fixed to a frame."""
        out = {body: self._link_after(j) for j, body in enumerate(self.joint_bodies)}
        return out | {body: self.frame_starts[j] + k for body, j, k in self.frame_bodies}

    def _link_after(self, j: int) -> int:
        """Return the link that joint j moves: its last dof, or the frame of a flexible link."""
        joint = self.joints[j]
        if isinstance(joint, Flexible):
            return self.frame_starts[j] + joint.body_frame
        return self.joint_v[j] + joint.nv - 1

    def _carrier(self, body: int) -> int:
        """Return the body, if it has a link, else its nearest ancestor with a link, or WORLD."""
        while body != WORLD and body not in self.last_links:
            body = self.body_parents[body]
        return body

    @cached_property
    def carriers(self) -> tuple[int, ...]:
        """The nearest body with a link at or above each body in the tree, or WORLD."""
        return tuple(self._carrier(b) for b in range(self.nb))

    @cached_property
    def body_links(self) -> tuple[int, ...]:
        """The link that carries each body, or WORLD."""
        return tuple(WORLD if c == WORLD else self.last_links[c] for c in self.carriers)

    @cached_property
    def weld_depth(self) -> tuple[int, ...]:
        """The number of welds between each body and its carrier or the world."""
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
        """The path of links from the root to each link."""
        out: dict[int, tuple[int, ...]] = {WORLD: ()}

        def path(i: int) -> tuple[int, ...]:
            if i not in out:
                out[i] = (*path(self.parents[i]), i)
            return out[i]

        return tuple(path(i) for i in range(len(self.parents)))

    @cached_property
    def constant_axes(self) -> bool:
        """True if the axis of each dof is constant in the frame of the dof."""
        return all(dof.kind.constant_axis for dof in self.links)


def _unpickle(fields: dict[str, Any]) -> Topology:
    joints = tuple(load_kind(*x) for x in fields["joints"])
    return Topology(**fields | {"joints": joints})


def _moved(some: range, start: int) -> range:
    return range(some.start + start, some.stop + start)


def _starts(sizes: list[int]) -> tuple[int, ...]:
    return tuple(accumulate([0, *sizes]))[:-1]
