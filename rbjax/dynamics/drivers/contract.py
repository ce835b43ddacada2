"""The interface of drivers, which run a recursion over the tree.

A recursion is written once, as a step on the lanes of one link. A driver runs it over the tree.

A *per-link value* contains one pytree of lanes for each link, in the form of its driver: a list
(`Unrolled`), a list and columns (`Rolled`), lists for the trunk and the limbs (`Limbs`). The *whole
form* is for computations on all links at once, outside the recursions: a list over the links if
`listed`, else columns.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax

from rbjax.joints import FrameKind, JointMotion
from rbjax.lanes import Lane, Vec3
from rbjax.model import Dof, LinkConstants, ModelConstants, Topology
from rbjax.spatial import Motion

PerLink = Any  # a pytree in the form of the driver
Whole = Any  # list over the links, or columns

#: step(x, carry or message) -> carry or message, y
Step = Callable[[Any, Any], tuple[Any, Any]]


class Driver(abc.ABC):
    """An executor of recursions over the tree of a robot."""

    topology: Topology
    prepared: ModelConstants
    constants: PerLink
    #: True if the whole form is a list
    listed: bool
    #: the number of links in one iteration of the loop, if there is one
    unroll = 1

    @abc.abstractmethod
    def joints(self, q: jax.Array, v: jax.Array | None, *along: jax.Array) -> PerLink:
        """Compute the joint motion of each link. v = None means at rest.

        along: nothing, or accelerations and virtual rates (nv, ...). Frames of flexible links then
            are `VirtualFrame`s. Drivers of trees with such links accept them.
        """

    @abc.abstractmethod
    def lanes(self, x: jax.Array | None, links: Sequence[int] | None = None) -> PerLink:
        """Convert an array (nv, ...) to one lane for each link. None means zeros.
        links: the links of the rows of x, in order, by default those with a coordinate. The others
            get zero."""

    @abc.abstractmethod
    def scattered(self, values: Mapping[int, Any], zero: Any) -> PerLink:
        """Convert a map from link index to value to a per-link value. Other links get `zero`."""

    @abc.abstractmethod
    def pack(
        self, lanes: PerLink, like: jax.Array, links: Sequence[int] | None = None
    ) -> jax.Array:
        """Convert one lane for each link to an array (nv, ...).
        links: the links of its rows, in order, by default those with a coordinate."""

    @abc.abstractmethod
    def columns(self, values: PerLink, like: jax.Array) -> Any:
        """Convert per-link values to one pytree of arrays over the links (nv, ...)."""

    @abc.abstractmethod
    def zip(self, *values: PerLink) -> PerLink:
        """Combine per-link values to tuples of the values of each link."""

    @abc.abstractmethod
    def part(self, values: PerLink, k: int) -> PerLink:
        """Return entry k of the tuple of each link."""

    @abc.abstractmethod
    def outward(self, step: Step, root: Any, xs: PerLink) -> PerLink:
        """Run carry_i, y_i = step(x_i, carry of the parent) from root to tips. Return the y_i."""

    @abc.abstractmethod
    def inward(self, step: Step, zero: Any, xs: PerLink) -> PerLink:
        """Run message_i, y_i = step(x_i, sum of child messages) to the root. Return the y_i."""

    @abc.abstractmethod
    def whole(self, values: PerLink) -> Whole:
        """Convert per-link values to the whole form: a list or columns over all links."""

    @abc.abstractmethod
    def rows(self, whole: Whole) -> PerLink:
        """Convert values over all links, as `whole` returns them, to per-link values."""

    @abc.abstractmethod
    def each(self, f: Callable, *whole: Whole) -> Whole:
        """Apply f to the values of each link. Arguments and result are lists, or columns over all
        links."""

    @abc.abstractmethod
    def take(self, whole: Whole, index: Sequence[int], world: Any = None) -> Whole:
        """Select the values of the links `index` from a list, or columns, over all links. The value
        of index WORLD is `world`."""

    @abc.abstractmethod
    def stack(self, whole: Whole, lanes: Callable, like: jax.Array) -> jax.Array:
        """Stack the lanes `lanes(value)` of each link to the rows of an array (links, lanes)."""

    @abc.abstractmethod
    def literals(self, numbers: list[float]) -> Whole:
        """Convert one compile-time constant per link to a list, or to columns, over all links."""

    def total(self, values: PerLink) -> Lane:
        """Return the sum of one lane for each link."""
        raise NotImplementedError(f"{type(self).__name__}.total")

    def unzip(self, tuples: PerLink, count: int) -> tuple[PerLink, ...]:
        """Split the tuples of `zip` into `count` per-link values."""
        return tuple(self.part(tuples, k) for k in range(count))

    def out_and_in(self, outward: Step, root: Any, inward: Step, zero: Any, xs: PerLink) -> PerLink:
        """Run an outward sweep over x_i that returns y_i, then an inward sweep over (x_i, y_i)."""
        return self.inward(inward, zero, self.zip(xs, self.outward(outward, root, xs)))

    def axes(self, joints: PerLink) -> tuple[PerLink, PerLink]:
        """Return S and its time derivative S' of each link in its own axes, per link."""

        def step(joint: JointMotion, _: tuple) -> tuple[tuple, tuple[Motion, Motion]]:
            return (), (joint.S, joint.S_rate)

        S, S_rate = self.unzip(self.outward(step, (), joints), 2)
        return S, S_rate

    def whole_axes(self, joints: PerLink) -> Whole:
        """Return the axis S of each link in its own axes: a list, or columns over all links."""
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
    """Compute the motion of one dof from q and v of the robot."""
    return dof.kind.motion([q[k] for k in dof.q], [v[k] for k in dof.v], constants)


def frame_motions(
    frame: Dof,
    constants: LinkConstants,
    q: Sequence[Lane],
    v: Sequence[Lane],
    *along: Sequence[Lane],
) -> Sequence[JointMotion]:
    """Compute the motions of all frames of the flexible link of a frame."""
    assert isinstance(frame.kind, FrameKind)
    rates = ([x[k] for k in frame.v] for x in along)
    return frame.kind.motions([q[k] for k in frame.q], [v[k] for k in frame.v], constants, *rates)
