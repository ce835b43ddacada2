"""The unrolled driver, whose program contains the step of every link, and drivers of lists."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.drivers.contract import Driver, Step, dof_motion, frame_motions
from rbjax.joints import JointMotion
from rbjax.lanes import Lane, add, fusion_barrier, is_zero, pack, total, unpack
from rbjax.model import WORLD, Model, ModelConstants


class ListDriver(Driver):
    """A driver whose whole form is a list of one value for each link."""

    listed = True

    def columns(self, values: Any, like: jax.Array) -> Any:
        return jax.tree.map(lambda *lanes: pack(lanes, like), *self.whole(values))

    def each(self, f: Callable, *whole: list) -> list:
        return [fusion_barrier(f(*x), known=x) for x in zip(*whole, strict=True)]

    def take(self, whole: list, index: Sequence[int], world: Any = None) -> list:
        if list(index) == list(range(len(whole))):
            return whole
        return [world if i == WORLD else whole[i] for i in index]

    def stack(self, whole: list, lanes: Callable, like: jax.Array) -> jax.Array:
        rows = [list(lanes(x)) for x in whole]
        flat = [x for row in rows for x in row]
        return pack(flat, jnp.zeros(len(flat), like.dtype)).reshape(len(rows), -1)

    def literals(self, numbers: list[float]) -> list[Lane]:
        return list(numbers)


class Unrolled(ListDriver):
    """The driver that writes the steps of all links into the program. Per-link values are lists."""

    def __init__(self, model: Model, prepared: ModelConstants | None):
        """Create a driver. `prepared` is None if the steps need no constants of the links."""
        self.topology, self.constants = model.topology, []
        if prepared is not None:
            self.prepared = prepared
            self.constants = [prepared.link(i) for i in range(len(model.topology.links))]

    def joints(self, q: jax.Array, v: jax.Array | None, *along: jax.Array) -> list[JointMotion]:
        qs, vs, top = unpack(q), self.lanes(v), self.topology
        rates = list(map(unpack, along))
        out = [dof_motion(dof, self.constants[i], qs, vs) for i, dof in enumerate(top.dofs)]
        for i in top.frame_starts.values():
            out += frame_motions(top.links[i], self.constants[i], qs, vs, *rates)
        return fusion_barrier(out)

    def lanes(self, x: jax.Array | None, links: Sequence[int] | None = None) -> list[Lane]:
        given = range(self.topology.nv) if links is None else links
        return self.scattered({} if x is None else dict(zip(given, unpack(x), strict=True)), 0.0)

    def total(self, values: list[Lane]) -> Lane:
        return total(values)

    def scattered(self, values: Mapping[int, Any], zero: Any) -> list:
        return [values.get(i, zero) for i in range(len(self.topology.links))]

    def pack(
        self, lanes: list[Lane], like: jax.Array, links: Sequence[int] | None = None
    ) -> jax.Array:
        rows = range(self.topology.nv) if links is None else links
        return pack([lanes[i] for i in rows], like)

    def whole(self, values: list) -> list:
        return values

    def rows(self, whole: list) -> list:
        return whole

    def zip(self, *values: list) -> list[tuple]:
        return list(zip(*values, strict=True))

    def part(self, values: list[tuple], k: int) -> list:
        return [x[k] for x in values]

    def outward(self, step: Step, root: Any, xs: list) -> list:
        top = self.topology
        return outward(top.parents, step, root, xs, order=top.order)[1]

    def inward(self, step: Step, zero: Any, xs: list) -> list:
        top = self.topology
        return inward(top.parents, step, [zero] * len(xs), xs, order=top.order)[1]

    def out_and_in(self, out: Step, root: Any, back: Step, zero: Any, xs: list) -> list:
        ys = self.outward(out, root, xs)
        return self.inward(back, zero, list(zip(xs, ys, strict=True)))


def outward(
    parents: Sequence[int],
    step: Step,
    root: Any,
    xs: list,
    known: Any = (),
    order: Sequence[int] | None = None,
) -> tuple[list, list]:
    """Run `step` from the root to the leaves. Return the carry and the output of each link.

    A fusion barrier follows each step, except for values in `known` and inputs of the steps.
    `order` has parents before children; None if the indices of the links do.
    """
    carries, ys = list(xs), list(xs)
    for i in range(len(xs)) if order is None else order:
        x, before = xs[i], root if parents[i] == WORLD else carries[parents[i]]
        carries[i], ys[i] = fusion_barrier(step(x, before), known=(x, before, known))
    return carries, ys


def inward(
    parents: Sequence[int],
    step: Step,
    sums: list,
    xs: list,
    known: Any = (),
    order: Sequence[int] | None = None,
) -> tuple[list, list]:
    """Run an unrolled inward sweep, from the leaves to the root. Return the message of each link to
    its parent, and the output of each link.
    sums: initial sum of messages at each link, from other sweeps."""
    sums, messages, ys = list(sums), list(xs), list(xs)
    for i in reversed(range(len(xs)) if order is None else order):
        messages[i], ys[i] = fusion_barrier(step(xs[i], sums[i]), known=(xs[i], sums[i], known))
        if parents[i] != WORLD:
            sums[parents[i]] = _sum(sums[parents[i]], messages[i])
    return messages, ys


def _sum(total: Any, message: Any) -> Any:
    """Add two messages. A structural zero may have fewer leaves than the other message."""
    same = jax.tree.structure(total) == jax.tree.structure(message)  # type: ignore[operator]
    if not same:
        assert all(is_zero(x) for x in jax.tree.leaves(total))
        return message
    return jax.tree.map(add, total, message)
