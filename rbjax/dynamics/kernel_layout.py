"""The tree as a kernel's loops see it: a floating base, slots, integers by link."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbjax.dynamics.drivers import allocate_slots
from rbjax.model import WORLD, Topology


def is_plain(link: Any) -> bool:
    """A hinge of its own."""
    return link.kind == "hinge" and link.part is None


def base_links(top: Topology) -> int:
    """6 where a free joint carries all the rest, else 0."""
    free = top.nv >= 6 and top.joint_kinds[top.links[0].joint] == "free"
    return 6 if free and WORLD not in top.parents[1:] else 0


def slots(top: Topology) -> tuple[int, dict[int, int]]:
    """`allocate_slots`, and always one for a floating base."""
    count, slot_of = allocate_slots(top.parents)
    if base_links(top) and 5 not in slot_of:
        return count + 1, slot_of | {5: count}
    return count, slot_of


# rows by link of what `layout` gives
Q, SOURCE, KEEP, TARGET, FIRST, TURNS, JOINT, ACTUATOR, SINGLE = range(9)


def layout(top: Topology, actuated: tuple[int, ...] = ()) -> np.ndarray:
    """Integers by link: its place in q, slots, whether it turns, its joint and its actuator; and
    the links of `single_links`."""
    links, parents, slot_of = top.links, np.array(top.parents), slots(top)[1]
    n = len(parents)
    chained = parents == np.arange(n) - 1
    chained[base_links(top) :][:1] &= base_links(top) == 0
    source = np.where(chained, -1, [slot_of.get(p, -1) for p in top.parents])
    keep = np.array([slot_of.get(i, -1) for i in range(n)])
    target = np.where(parents == WORLD, -2, source)
    first = np.zeros(n, int)
    for i in range(n):  # the last child of a branch point comes first on the way in
        if target[i] >= 0 and not any(top.parents[k] == top.parents[i] for k in range(i + 1, n)):
            first[i] = 1
    q = np.array([0 if link.q is None else link.q for link in links])
    turns = np.array([link.kind == "hinge" for link in links])
    joint = np.array([link.joint for link in links])
    actuator = np.array([actuated.index(j) if j in actuated else -1 for j in joint])
    single = np.zeros(n, int)
    single[: len(single_links(top, actuated))] = single_links(top, actuated)
    rows = [q, source, keep, target, first, turns, joint, actuator, single]
    return np.stack(rows).astype(np.int32)


def single_links(top: Topology, actuated: tuple[int, ...]) -> list[int]:
    """Links whose coordinate is a joint of its own, with one actuator at most."""
    links = enumerate(top.links)
    return [i for i, link in links if link.part is None and actuated.count(link.joint) <= 1]
