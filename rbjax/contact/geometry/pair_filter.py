"""MuJoCo's rules for the pairs of geoms that may touch.

Source: MuJoCo, *Computation*, "Collision detection".
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import NamedTuple

from rbjax.contact.geometry.narrow_phase import KINDS


class Collider(NamedTuple):
    """The properties of a geom that decide which other geoms it may touch.

    Fields:
        kind: name of the shape, such as "box".
        contype, conaffinity: bit masks. The contype of one geom must match the conaffinity of the
            other.
        body: index of the body.
        assembly: index of the rigid assembly of bodies, welded to each other, that has the body.
        parent: index of the assembly to which a joint connects this one, or None if that is the
            world or if a geom may touch those of the parent.
        fixed: whether no joint moves the body.
    """

    kind: str
    contype: int
    conaffinity: int
    body: int
    assembly: int
    parent: int | None
    fixed: bool


def may_touch(a: Collider, b: Collider, excluded: Collection[tuple[int, int]]) -> bool:
    """Return whether two geoms may touch.

    excluded: pairs of bodies whose geoms do not touch, the lesser index first.
    """
    masks = a.contype & b.conaffinity | b.contype & a.conaffinity
    if not masks or a.assembly == b.assembly or (a.fixed and b.fixed):
        return False
    if a.parent == b.assembly or b.parent == a.assembly:
        return False
    return (min(a.body, b.body), max(a.body, b.body)) not in excluded


def in_order(kinds: Sequence[str], a: int, b: int) -> tuple[int, int]:
    """Return a pair of geoms in the order of their kinds, then of their indices."""
    one, other = sorted((KINDS.index(kinds[g]), g) for g in (a, b))
    return one[1], other[1]
