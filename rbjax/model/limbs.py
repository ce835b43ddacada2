"""Isomorphic limbs of a tree: which parts of a robot repeat, so that one program serves them all.

A *limb* is a link that begins a joint, with all links that it carries. Limbs of the same shape (the
same tree of joints of the same kinds) form a *group*; what belongs to no group is the *trunk*. The
cost of a partition is the number of links whose steps are written out: those of the trunk, and of
one limb of each group.

A limb begins where the tree branches (its parent has other children, or is the world), so that a
leg is not cut in the middle to match the end of an arm: the more alike limbs are, the more of their
numbers are shared zeros. Groups are chosen greedily, the one that saves most first. One level only:
equal fingers on two equal hands are one group of fingers, or part of a group of two arms, whichever
saves more, never both.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from rbjax.model.topology import WORLD, Topology

#: links that a group must save, so that its loop pays
LEAST_SAVED = 2


class Group(NamedTuple):
    """Limbs of one shape; position k of each is the same place in that shape."""

    #: for each limb its links, parents before children
    links: tuple[tuple[int, ...], ...]
    #: for each position that of its parent, WORLD for the limb's first link
    parents: tuple[int, ...]
    #: for each limb the link of the trunk that carries it, or WORLD
    carriers: tuple[int, ...]


class Partition(NamedTuple):
    """Each link is in the trunk or in one limb; the trunk carries itself."""

    trunk: tuple[int, ...]
    groups: tuple[Group, ...]

    @property
    def written(self) -> int:
        """How many links' steps are written out."""
        return len(self.trunk) + sum(len(group.parents) for group in self.groups)


@lru_cache(maxsize=256)
def partition(top: Topology) -> Partition:
    """The trunk of a robot and its groups of limbs."""
    children: dict[int, list[int]] = {}
    for i, parent in enumerate(top.parents):
        children.setdefault(parent, []).append(i)
    numbers: dict[tuple, int] = {}  # of the shapes, in the order in which they are met
    shapes = [0] * top.nv
    members: list[tuple[int, ...]] = [()] * top.nv
    for i in reversed(range(top.nv)):
        link = top.dofs[i]
        below = sorted(children.get(i, ()), key=lambda k: (shapes[k], k))
        shape = (link.spec, *(shapes[k] for k in below))
        shapes[i] = numbers.setdefault(shape, len(numbers))
        members[i] = (i, *(k for child in below for k in members[child]))

    begins = [
        i for i, link in enumerate(top.dofs)
        if top.joint_v[link.joint] == i
        and (link.parent == WORLD or len(children[link.parent]) > 1)
    ]  # fmt: skip
    alike: dict[int, list[int]] = {}
    for i in begins:
        alike.setdefault(shapes[i], []).append(i)

    groups: list[Group] = []
    taken: set[int] = set()
    while True:
        free = [[i for i in roots if not taken & set(members[i])] for roots in alike.values()]
        best = max(free, key=lambda roots: _saved(roots, members), default=[])
        if _saved(best, members) < LEAST_SAVED:
            break
        groups.append(_group(top, [members[i] for i in best]))
        for i in best:
            taken.update(members[i])
    trunk = tuple(i for i in range(top.nv) if i not in taken)
    return Partition(trunk, tuple(sorted(groups, key=lambda group: group.links[0][0])))


def _saved(roots: list[int], members: list[tuple[int, ...]]) -> int:
    """Links that need not be written out if these limbs become a group."""
    return (len(roots) - 1) * len(members[roots[0]]) if roots else 0


def _group(top: Topology, links: list[tuple[int, ...]]) -> Group:
    first = links[0]
    parents = tuple(WORLD if k == 0 else first.index(top.parents[i]) for k, i in enumerate(first))
    return Group(tuple(links), parents, tuple(top.parents[limb[0]] for limb in links))
