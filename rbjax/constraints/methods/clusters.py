"""Clusters: the joints of a tree that rows tie together.

A row acts on some links and joints. Its forces stay below a link that carries all of these, if they
are internal (action and reaction, joint torques); the joints between that link and them are what it
reaches. Rows that reach a common joint share a cluster. A cluster is a connected part of the tree
with one parent, so clusters and the joints that no row reaches form a tree again.
(Jain 2012, *Multibody graph transformations and analysis, part II*; Chignoli, Adrian, Kim & Wensing
2023, *Recursive rigid-body dynamics algorithms for systems with kinematic loops*)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from rbjax.constraints.equations.system import by_link
from rbjax.constraints.rows.row import Row
from rbjax.forces.element import Loads
from rbjax.lanes import is_zero
from rbjax.model import WORLD, Topology


class Cluster(NamedTuple):
    """Fields: parent, the link on which it hangs, or WORLD; links, those that its joints move;
    rows, by index."""

    parent: int
    links: frozenset[int]
    rows: tuple[int, ...]


def clusters(topology: Topology, rows: Sequence[Row]) -> list[Cluster]:
    """The clusters that rows form. A row whose gradient is zero forms one without joints."""
    found: list[Cluster] = []
    for r, row in enumerate(rows):
        new = Cluster(*reach(topology, row.gradient), (r,))
        for met in [x for x in found if x.links & new.links]:
            found.remove(met)
            # each has all links from its own to its parent: one parent carries the other
            parent = min(met.parent, new.parent)
            new = Cluster(parent, met.links | new.links, (*met.rows, *new.rows))
        found.append(new)
    return found


def reach(topology: Topology, gradient: Loads) -> tuple[int, frozenset[int]]:
    """The link below which the forces of a row stay, and the links below it on which they act or
    that carry such."""
    pushed = [i for i, f in by_link(gradient).items() if not all(map(is_zero, f))]
    turned = [i for i, x in gradient.tau.items() if not is_zero(x)]
    tops = [topology.parents[i] for i in turned]
    tops += pushed if gradient.internal else [WORLD] * len(pushed)
    shared = set.intersection(*(_chain(topology, i) for i in tops)) if tops else set()
    parent = max(shared, default=WORLD)  # indices grow along a chain
    carrying = {j for i in pushed + turned for j in _chain(topology, i)}
    return parent, frozenset(carrying - _chain(topology, parent))


def _chain(topology: Topology, link: int) -> set[int]:
    """The link and those that carry it."""
    return set() if link == WORLD else set(topology.ancestors[link])
