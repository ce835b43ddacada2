"""Options that all rows of a contact problem share."""

from __future__ import annotations

from typing import Any, NamedTuple

from rbjax.lanes import Lane


class Options(NamedTuple):
    """Options that all contacts of a problem share.

    Fields:
        elliptic: whether friction cones are elliptic or pyramids.
        impratio: impedance of friction over the impedance of the normal row.
        dt: step in s, from which the least time constant of a contact follows.
        refsafe: whether time constants are at least two steps.
        discrete: whether the rows are those of the `discrete` integrator.
    """

    elliptic: bool
    impratio: Lane
    dt: Any
    refsafe: bool
    discrete: bool = False
