"""Partition of a tree into a trunk and groups of equal limbs, which share one program.

A *limb* in parallel is the subtree of a joint whose parent link is the world or has several
children. Limbs with equal trees of joint kinds form a *group* and share one program. All links
outside groups are the *trunk*. Groups are chosen greedily: the group that saves most links is
chosen first.

A limb in series is a segment of one or more joints that is repeated at the end of a chain, such as
a beam of a cable of equal beams. Trees with flexible links and without limbs in parallel use them.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

from rbjax.joints import Joint
from rbjax.model.topology import WORLD, Topology

#: the number of links that a group must save
LEAST_SAVED = 2


class Group(NamedTuple):
    """Limbs with equal trees, in parallel or in series. Position k is the same place in the tree of
    each limb."""

    #: the links of each limb, parents before children
    links: tuple[tuple[int, ...], ...]
    #: the position of the parent of each position, WORLD for position 0
    parents: tuple[int, ...]
    #: the link of the trunk that carries each limb, or WORLD; of limbs in series, the first one
    carriers: tuple[int, ...]
    #: the position that carries the next limb of a series; None for limbs in parallel
    port: int | None = None


class Partition(NamedTuple):
    """The trunk and the groups of a robot. Each link is in the trunk or in one limb."""

    trunk: tuple[int, ...]
    groups: tuple[Group, ...]

    @property
    def links_in_program(self) -> int:
        """The number of links in a program: all of the trunk, and one limb of each group."""
        return len(self.trunk) + sum(len(group.parents) for group in self.groups)


@lru_cache(maxsize=256)
def partition(top: Topology) -> Partition:
    """Partition the links of a robot into a trunk and groups of equal limbs.

    If a tree with flexible links has no equal limbs in parallel, limbs in series are a group.
    """
    found = partition_parallel(top)
    return partition_series(top) if top.frames and not found.groups else found


def partition_parallel(top: Topology) -> Partition:
    """Partition the links of a robot into a trunk and groups of equal limbs in parallel."""
    children: dict[int, list[int]] = {}
    for i, parent in enumerate(top.parents):
        children.setdefault(parent, []).append(i)
    numbers: dict[tuple, int] = {}  # shape of a subtree -> its number
    shapes = [0] * len(top.links)
    members: list[tuple[int, ...]] = [()] * len(top.links)
    for i in reversed(top.order):
        link = top.links[i]
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
    trunk = tuple(i for i in top.order if i not in taken)
    return Partition(trunk, tuple(sorted(groups, key=lambda group: group.links[0][0])))


def _saved(roots: list[int], members: list[tuple[int, ...]]) -> int:
    """Return the number of links that a group of these limbs saves."""
    return (len(roots) - 1) * len(members[roots[0]]) if roots else 0


def _group(top: Topology, links: list[tuple[int, ...]]) -> Group:
    first = links[0]
    parents = tuple(WORLD if k == 0 else first.index(top.parents[i]) for k, i in enumerate(first))
    return Group(tuple(links), parents, tuple(top.parents[limb[0]] for limb in links))


def partition_series(top: Topology) -> Partition:
    """Partition the links of a robot into a trunk and equal limbs in series at the end of a chain.

    Each limb is one or more joints, such as a beam and a hinge. The chain that saves most links is
    chosen.
    """
    links = [_joint_links(top, j) for j in range(len(top.joints))]
    owner = {i: j for j, own in enumerate(links) for i in own}
    above = [owner.get(top.parents[own[0]], WORLD) for own in links]
    children = [[k for k, a in enumerate(above) if a == j] for j in range(len(links))]
    best: tuple[int, list[list[int]]] = (0, [])
    for leaf in (j for j, below in enumerate(children) if not below):
        chain = [leaf]
        while above[chain[0]] != WORLD and len(children[above[chain[0]]]) == 1:
            chain.insert(0, above[chain[0]])
        place = [links[a].index(top.parents[links[j][0]]) if (a := above[j]) != WORLD else WORLD
                 for j in chain]  # fmt: skip
        tokens = [(top.joints[j], at) for j, at in zip(chain, place, strict=True)]
        for period in range(1, len(chain) // 2 + 1):
            count = _repeats(tokens, period)
            limbs = [chain[len(chain) - period * (n + 1) :][:period] for n in range(count)][::-1]
            saved = (count - 1) * sum(len(links[j]) for j in limbs[-1])
            if saved > best[0] and saved >= LEAST_SAVED:
                best = saved, limbs
    saved, limbs = best
    if not saved:
        return Partition(top.order, ())
    rank = {i: n for n, i in enumerate(top.order)}
    each = [
        tuple(sorted((i for j in limb for i in links[j]), key=rank.__getitem__)) for limb in limbs
    ]
    group = _group(top, each)
    port = each[0].index(top.parents[each[1][0]])
    taken = {i for limb in each for i in limb}
    trunk = tuple(i for i in top.order if i not in taken)
    return Partition(trunk, (group._replace(carriers=group.carriers[:1], port=port),))


def _joint_links(top: Topology, j: int) -> tuple[int, ...]:
    """Return the links of a joint: its dofs and frames."""
    dofs = range(top.joint_v[j], top.joint_v[j] + top.joints[j].nv)
    first = top.frame_starts.get(j)
    count = 0 if first is None else sum(frame.joint == j for frame in top.frames)
    return (*dofs, *(range(first, first + count) if first is not None else ()))


def _repeats(tokens: list[tuple[Joint, int]], period: int) -> int:
    """Count the equal limbs of `period` joints at the end of a chain.

    A token is the kind of a joint and its place on the joint before it. The place of the first
    limb does not matter.
    """
    count, end = 1, len(tokens)
    while (start := end - (count + 1) * period) >= 0:
        kinds = [tokens[start + k][0] is tokens[end - period + k][0] for k in range(period)]
        inner = [tokens[start + k][1] == tokens[end - period + k][1] for k in range(1, period)]
        # the next limb must sit on this limb where the others do
        port = count == 1 or tokens[start + period][1] == tokens[end - period][1]
        if not (all(kinds) and all(inner) and port):
            break
        count += 1
    return count
