"""The protocol of drivers, which mypy checks.

A *per-link value* holds one value for each link, in the form of its driver: a list (`Unrolled`), a
list and columns (`Rolled`), lists for the trunk and the limbs (`Limbs`). Values are pytrees of
lanes. The *whole* form is for work on all links at once, outside the recursions: a list over the
links if `listed`, else columns.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import jax

from rbjax.model import Prepared, Topology

PerLink = Any  # a pytree whose form the driver knows
Whole = Any  # list over the links, or columns

#: step(x, carry or message) -> carry or message, y
Step = Callable[[Any, Any], tuple[Any, Any]]


class Driver(Protocol):
    """How a recursion over the tree runs."""

    topology: Topology
    prepared: Prepared
    constants: PerLink
    #: whether `whole` is a list
    listed: bool
    #: links in one iteration of the loop, if there is one
    unroll: int

    def joints(self, q: jax.Array, v: jax.Array | None) -> PerLink:
        """The joint motion of each link."""

    def lanes(self, x: jax.Array | None) -> PerLink:
        """An array (nv, ...) as one lane a link; zeros if None."""

    def scattered(self, values: Mapping[int, Any], zero: Any) -> PerLink:
        """Values of some links, by index; `zero` for all others."""

    def pack(self, lanes: PerLink, like: jax.Array) -> jax.Array:
        """One lane a link as an array (nv, ...)."""

    def columns(self, values: PerLink, like: jax.Array) -> Any:
        """One pytree of columns (nv, ...), for work with whole arrays."""

    def zip(self, *values: PerLink) -> PerLink:
        """Tuples of the values of each link."""

    def part(self, values: PerLink, k: int) -> PerLink:
        """Entry k of each tuple."""

    def unzip(self, tuples: PerLink, count: int) -> tuple[PerLink, ...]:
        """The inverse of `zip`, for `count` values."""

    def outward(self, step: Step, root: Any, xs: PerLink) -> PerLink:
        """carry_i, y_i = step(x_i, carry of the parent), from the root out; the y_i."""

    def inward(self, step: Step, zero: Any, xs: PerLink) -> PerLink:
        """message_i, y_i = step(x_i, sum of the children's messages), from the tips in; the y_i."""

    def out_and_in(self, outward: Step, root: Any, inward: Step, zero: Any, xs: PerLink) -> PerLink:
        """An outward sweep with the steps outward(x_i, carry) gives y_i. Then an inward one with
        the steps inward((x_i, y_i), messages) gives the result."""

    def whole(self, values: PerLink) -> Whole:
        """Values in the form for work on all links at once."""

    def rows(self, whole: Whole) -> PerLink:
        """The inverse of `whole`."""

    def each(self, f: Callable, *whole: Whole) -> Whole:
        """f of each link's values."""

    def take(self, whole: Whole, index: Sequence[int], world: Any = None) -> Whole:
        """The values of these links; `world` where an index is WORLD."""

    def stack(self, whole: Whole, lanes: Callable, like: jax.Array) -> jax.Array:
        """The lanes of each value side by side, as an array (values, lanes)."""

    def known(self, numbers: list[float]) -> Whole:
        """Constants of the program, one a link, as a lane or a list of lanes."""


class Sweeps:
    """Methods that follow from the sweeps of a driver."""

    def out_and_in(
        self: Driver, outward: Step, root: Any, inward: Step, zero: Any, xs: PerLink
    ) -> PerLink:
        """As `Driver.out_and_in`."""
        return self.inward(inward, zero, self.zip(xs, self.outward(outward, root, xs)))

    def unzip(self: Driver, tuples: PerLink, count: int) -> tuple[PerLink, ...]:
        """As `Driver.unzip`."""
        return tuple(self.part(tuples, k) for k in range(count))
