"""The unrolled driver, which writes out every link's step, and code shared by drivers of lists.

`outward` passes each step its parent's carry, `inward` the sum of its children's messages.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.drivers.contract import Step, Sweeps
from rbjax.dynamics.drivers.joint_lanes import joint_lanes
from rbjax.dynamics.drivers.packing import pack, unpack
from rbjax.joints import JointMotion
from rbjax.lanes import Lane, add, fusion_barrier
from rbjax.model import WORLD, Model, Prepared


class Listed:
    """Work on all links at once, if `whole` is a list of one value for each link."""

    listed, unroll = True, 1

    def each(self, f: Callable, *whole: list) -> list:
        """f of each link's values."""
        return [fusion_barrier(f(*x), known=x) for x in zip(*whole, strict=True)]

    def take(self, whole: list, index: Sequence[int], world: Any = None) -> list:
        """The values of these links; `world` where an index is WORLD."""
        if list(index) == list(range(len(whole))):
            return whole
        return [world if i == WORLD else whole[i] for i in index]

    def stack(self, whole: list, lanes: Callable, like: jax.Array) -> jax.Array:
        """The lanes of each value side by side, as an array (values, lanes)."""
        rows = [list(lanes(x)) for x in whole]
        flat = [x for row in rows for x in row]
        return pack(flat, jnp.zeros(len(flat), like.dtype)).reshape(len(rows), -1)

    def known(self, numbers: list[float]) -> list[Lane]:
        """Constants of the program, one a link, in the form of `whole`."""
        return list(numbers)


class Unrolled(Sweeps, Listed):
    """Steps written one after another. Per-link values are lists."""

    prepared: Prepared

    def __init__(self, model: Model, prepared: Prepared | None):
        """`prepared` is None if the steps need no constants of the links."""
        self.topology, self.constants = model.topology, []
        if prepared is not None:
            self.prepared = prepared
            self.constants = [prepared.link(i) for i in range(model.nv)]

    def joints(self, q: jax.Array, v: jax.Array | None) -> list[JointMotion]:
        """The joint motion of each link."""
        qs = unpack(q)
        vs = self.lanes(v)
        links = enumerate(self.topology.dofs)
        return fusion_barrier([joint_lanes(link, self.constants[i], qs, vs) for i, link in links])

    def lanes(self, x: jax.Array | None) -> list[Lane]:
        """An array (nv, ...) as one lane per link; zeros if None."""
        return [0.0] * self.topology.nv if x is None else unpack(x)

    def scattered(self, values: Mapping[int, Any], zero: Any) -> list:
        """Values of some links, by index, as a per-link value; `zero` for all others."""
        return [values.get(i, zero) for i in range(self.topology.nv)]

    def pack(self, lanes: list[Lane], like: jax.Array) -> jax.Array:
        """One lane per link as an array (nv, ...)."""
        return pack(lanes, like)

    def columns(self, values: list, like: jax.Array) -> Any:
        """Per-link pytrees as one pytree of columns (nv, ...), for work with whole arrays."""
        return jax.tree.map(lambda *lanes: pack(lanes, like), *values)

    def whole(self, values: list) -> list:
        """Per-link values in the form for work on all links at once, outside the recursions."""
        return values

    def rows(self, whole: list) -> list:
        """The inverse of `whole`."""
        return whole

    def zip(self, *values: list) -> list[tuple]:
        """Per-link tuples of per-link values."""
        return list(zip(*values, strict=True))

    def part(self, values: list[tuple], k: int) -> list:
        """Entry k of each per-link tuple."""
        return [x[k] for x in values]

    def outward(self, step: Step, root: Any, xs: list) -> list:
        """carry_i, y_i = step(x_i, carry of the parent), from the root out; the list of y_i."""
        return outward(self.topology.parents, step, root, xs)[1]

    def inward(self, step: Step, zero: Any, xs: list) -> list:
        """message_i, y_i = step(x_i, sum of the children's messages), from the tips in."""
        return inward(self.topology.parents, step, [zero] * len(xs), xs)[1]

    def out_and_in(self, out: Step, root: Any, back: Step, zero: Any, xs: list) -> list:
        """As `Sweeps.out_and_in`."""
        ys = outward(self.topology.parents, out, root, xs)[1]
        return self.inward(back, zero, list(zip(xs, ys, strict=True)))


def outward(
    parents: Sequence[int], step: Step, root: Any, xs: list, known: Any = ()
) -> tuple[list, list]:
    """The carries and the y_i of an unrolled outward sweep. `known` and the inputs of the steps are
    not materialized."""
    carries: list = []
    ys: list = []
    for parent, x in zip(parents, xs, strict=True):
        before = root if parent == WORLD else carries[parent]
        carry, y = fusion_barrier(step(x, before), known=(x, before, known))
        carries.append(carry)
        ys.append(y)
    return carries, ys


def inward(
    parents: Sequence[int], step: Step, sums: list, xs: list, known: Any = ()
) -> tuple[list, list]:
    """The messages and the y_i of an inward sweep. `sums` are messages from other sweeps."""
    sums, messages, ys = list(sums), list(xs), list(xs)
    for i in reversed(range(len(xs))):
        messages[i], ys[i] = fusion_barrier(step(xs[i], sums[i]), known=(xs[i], sums[i], known))
        if parents[i] != WORLD:
            sums[parents[i]] = jax.tree.map(add, sums[parents[i]], messages[i])
    return messages, ys
