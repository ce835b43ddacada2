"""Candidate contacts of pairs of geoms: their list and their narrow phase."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from rbjax.contact.geometry.narrow_phase import COUNTS, PAIRS
from rbjax.contact.geometry.shapes import Contact, Shape
from rbjax.lanes import Lane
from rbjax.model.geoms import Geoms
from rbjax.model.hulls import Hull


class PairKind(NamedTuple):
    """The static data of a pair on which its narrow phase depends. Pairs of one kind share it.

    Fields:
        one, other: the kinds of both geoms, in MuJoCo's order.
        hull: the hull of the other geom if it is a mesh, or None.
        field: the index of the height field of the first geom, or -1.
    """

    one: str
    other: str
    hull: Hull | None = None
    field: int = -1

    @classmethod
    def of(cls, geoms: Geoms, pair: tuple[int, int]) -> PairKind:
        """Return the kind of a pair of geoms."""
        a, b = pair
        hull = geoms.hulls[b] if geoms.hulls and geoms.types[b] == "mesh" else None
        field = geoms.fields[a] if geoms.fields else -1
        return cls(geoms.types[a], geoms.types[b], hull, field)

    @property
    def kinds(self) -> tuple[str, str]:
        """The kinds of both geoms."""
        return self.one, self.other

    @property
    def supported(self) -> bool:
        """Whether there is a narrow phase for the pair."""
        return self.kinds in PAIRS and (self.other != "mesh" or self.hull is not None)


def pairs_of_candidates(geoms: Geoms, pairs: Sequence[tuple[int, int]]) -> list[int]:
    """Return the index of the pair of each candidate, in the order of the narrow phase."""
    counts = [COUNTS[geoms.types[a], geoms.types[b]] for a, b in pairs]
    return [i for i, count in enumerate(counts) for _ in range(count)]


def pair_contacts(
    kind: PairKind, one: Shape, other: Shape, reach: Lane, heights: Sequence[Any] = ()
) -> list[Contact]:
    """Return the candidates of one pair, `COUNTS[kind.kinds]` of them.

    Args:
        kind: the kind of the pair.
        one, other: both shapes; the surfaces of meshes and fields are those of `kind`.
        reach: m, the greatest distance of a contact.
        heights: `Geoms.heights`.
    """
    if kind.hull is not None:
        other = other._replace(surface=kind.hull)
    if kind.one == "hfield":
        one = one._replace(surface=heights[kind.field])
    return PAIRS[kind.kinds](one, other, reach)
