"""The contract of drivers: how a recursion over the tree runs.

A recursion is written once, as a step on the lanes of one link. A driver runs it over the tree.

A *per-link value* holds one value for each link, in the form of its driver: a list (`Unrolled`), a
list and columns (`Rolled`), lists for the trunk and the limbs (`Limbs`). Values are pytrees of
lanes. The *whole* form is for work on all links at once, outside the recursions: a list over the
links if `listed`, else columns.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from rbjax.joints import JointMotion
from rbjax.lanes import Lane, Vec3
from rbjax.model import Dof, LinkConstants, Prepared, Topology
from rbjax.spatial import Motion

PerLink = Any  # a pytree in the form of the driver
Whole = Any  # list over the links, or columns

#: step(x, carry or message) -> carry or message, y
Step = Callable[[Any, Any], tuple[Any, Any]]


class Driver(abc.ABC):
    """How a recursion over the tree runs."""

    topology: Topology
    prepared: Prepared
    constants: PerLink
    #: whether `whole` is a list
    listed: bool
    #: links in one iteration of the loop, if there is one
    unroll = 1

    @abc.abstractmethod
    def joints(self, q: jax.Array, v: jax.Array | None) -> PerLink:
        """The joint motion of each link; at rest if v is None."""

    @abc.abstractmethod
    def lanes(self, x: jax.Array | None) -> PerLink:
        """An array (nv, ...) as one lane a link; zeros if None."""

    @abc.abstractmethod
    def scattered(self, values: Mapping[int, Any], zero: Any) -> PerLink:
        """Values of some links, by index; `zero` for all others."""

    @abc.abstractmethod
    def pack(self, lanes: PerLink, like: jax.Array) -> jax.Array:
        """One lane a link as an array (nv, ...)."""

    @abc.abstractmethod
    def columns(self, values: PerLink, like: jax.Array) -> Any:
        """One pytree of columns (nv, ...), for work with whole arrays."""

    @abc.abstractmethod
    def zip(self, *values: PerLink) -> PerLink:
        """Tuples of the values of each link."""

    @abc.abstractmethod
    def part(self, values: PerLink, k: int) -> PerLink:
        """Entry k of each tuple."""

    @abc.abstractmethod
    def outward(self, step: Step, root: Any, xs: PerLink) -> PerLink:
        """The y_i of carry_i, y_i = step(x_i, carry of the parent), from the root to the tips."""

    @abc.abstractmethod
    def inward(self, step: Step, zero: Any, xs: PerLink) -> PerLink:
        """The y_i of message_i, y_i = step(x_i, sum of the children's messages), from the tips to
        the root."""

    @abc.abstractmethod
    def whole(self, values: PerLink) -> Whole:
        """Values in the form for work on all links at once."""

    @abc.abstractmethod
    def rows(self, whole: Whole) -> PerLink:
        """The inverse of `whole`."""

    @abc.abstractmethod
    def each(self, f: Callable, *whole: Whole) -> Whole:
        """f of each link's values."""

    @abc.abstractmethod
    def take(self, whole: Whole, index: Sequence[int], world: Any = None) -> Whole:
        """The values of these links; `world` where an index is WORLD."""

    @abc.abstractmethod
    def stack(self, whole: Whole, lanes: Callable, like: jax.Array) -> jax.Array:
        """The lanes of each value as a row of an array (values, lanes)."""

    @abc.abstractmethod
    def literals(self, numbers: list[float]) -> Whole:
        """Constants of the program, one a link, as a lane or a list of lanes."""

    def unzip(self, tuples: PerLink, count: int) -> tuple[PerLink, ...]:
        """The inverse of `zip`, for `count` values."""
        return tuple(self.part(tuples, k) for k in range(count))

    def out_and_in(self, outward: Step, root: Any, inward: Step, zero: Any, xs: PerLink) -> PerLink:
        """Run an outward sweep with outward(x_i, carry) -> y_i, then an inward one with
        inward((x_i, y_i), messages)."""
        return self.inward(inward, zero, self.zip(xs, self.outward(outward, root, xs)))

    def axes(self, joints: PerLink) -> tuple[PerLink, PerLink]:
        """S and S' of each link in its own axes."""

        def step(joint: JointMotion, _: tuple) -> tuple[tuple, tuple[Motion, Motion]]:
            return (), (joint.S, joint.S_rate)

        S, S_rate = self.unzip(self.outward(step, (), joints), 2)
        return S, S_rate

    def whole_axes(self, joints: PerLink) -> Whole:
        """S of each link in its own axes; literals if all kinds have shared axes."""
        kinds = [dof.kind for dof in self.topology.dofs]
        if not all(kind.constant_axis and kind.shared_axis for kind in kinds):
            return self.whole(self.axes(joints)[0])

        def axis(angular: Lane, linear: Lane) -> Motion:
            return Motion(Vec3(0.0, 0.0, angular), Vec3(0.0, 0.0, linear))

        angular = self.literals([k.angular for k in kinds])
        return self.each(axis, angular, self.literals([k.linear for k in kinds]))


def dof_motion(
    dof: Dof, constants: LinkConstants, q: Sequence[Lane], v: Sequence[Lane]
) -> JointMotion:
    """The motion of one dof, from the coordinates of all."""
    return dof.kind.motion([q[k] for k in dof.q], [v[k] for k in dof.v], constants)
