"""Drivers: how a recursion over the tree runs.

A recursion is written once, as a step on the lanes of one link; a driver walks the tree with it:

- `Unrolled` writes the steps one after another into the program. Structural zeros differ from link
  to link, so this is the least arithmetic and the fastest code; compile time grows with the tree.
- `Rolled` (rolled.py) is a `lax.scan` over the links: one step is compiled however many there are.

`outward` hands each step its parent's carry, `inward` the sum of its children's messages.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.joints import JointMotion, joint_lanes
from rbjax.dynamics.packing import pack, unpack
from rbjax.dynamics.rolled import Rolled, Step
from rbjax.dynamics.rolled import allocate_slots as allocate_slots
from rbjax.lanes import Lane, add
from rbjax.materialize import materialize
from rbjax.model import WORLD, Model, Prepared, prepare

#: above this many velocity coordinates "auto" rolls. On the CPU unrolled code runs two to three
#: times as fast, but compiling its gradient takes 0.8 s a link, rolled 4 s whatever the length
#: (benchmarks/results/cpu-thresholds-*.json: chains of 4 to 16).
UNROLLED_UP_TO = 8

#: the same on the CPU for values of a model whose numbers are part of the program: a humanoid's
#: forward dynamics runs ten times as fast (alone, within a loop, 25 times) and compiles in 3 s
#: instead of 2; where the model is an argument it would be twice as fast and take 15 s
VALUES_UNROLLED_UP_TO = 40


class Unrolled:
    """Steps written out one after another. Per-link values are lists."""

    def __init__(self, model: Model, prepared: Prepared):
        self.topology, self.prepared = model.topology, prepared
        self.constants = [prepared.link(i) for i in range(model.nv)]

    def joints(self, q: jax.Array, v: jax.Array | None) -> list[JointMotion]:
        """The joint motion of each link."""
        qs = unpack(q)
        vs = self.lanes(v)
        links = enumerate(self.topology.links)
        return materialize([joint_lanes(link, self.constants[i], qs, vs, i) for i, link in links])

    def lanes(self, x: jax.Array | None) -> list[Lane]:
        """An array (nv, ...) as one lane per link; zeros if None."""
        return [0.0] * self.topology.nv if x is None else unpack(x)

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

    def each(self, f: Callable, *whole: list) -> list:
        """f of each link's values."""
        return [materialize(f(*x), known=x) for x in zip(*whole, strict=True)]

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
        """Numbers that are part of the program, one a link."""
        return list(numbers)

    def zip(self, *values: list) -> list[tuple]:
        """Per-link tuples of per-link values."""
        return list(zip(*values, strict=True))

    def unzip(self, tuples: list) -> tuple[list, ...]:
        """The inverse of `zip`."""
        return tuple(list(values) for values in zip(*tuples, strict=True))

    def outward(self, step: Step, root: Any, xs: list) -> list:
        """carry_i, y_i = step(x_i, carry of the parent), from the root out; the list of y_i."""
        carries: list = []
        ys: list = []
        for parent, x in zip(self.topology.parents, xs, strict=True):
            before = root if parent == WORLD else carries[parent]
            carry, y = materialize(step(x, before), known=(x, before))
            carries.append(carry)
            ys.append(y)
        return ys

    def inward(self, step: Step, zero: Any, xs: list) -> list:
        """message_i, y_i = step(x_i, sum of the children's messages), from the tips in."""
        sums = [zero] * len(xs)
        ys: list = [None] * len(xs)
        for i in reversed(range(len(xs))):
            message, ys[i] = materialize(step(xs[i], sums[i]), known=(xs[i], sums[i]))
            parent = self.topology.parents[i]
            if parent != WORLD:
                sums[parent] = jax.tree.map(add, sums[parent], message)
        return ys


Driver = Any  # Unrolled or Rolled; per-link values are lists or columns accordingly
DRIVERS: dict[str, type[Unrolled] | type[Rolled]] = {"unrolled": Unrolled, "rolled": Rolled}


def driver(model: Model, dtype: Any, *, values: bool = False) -> Driver:
    """The driver that the model asks for; "auto" unrolls small trees and rolls large ones.
    `values`: the model's numbers are known while tracing, and nobody differentiates what runs."""
    name = model.driver
    if name == "auto":
        few = values and jax.default_backend() == "cpu"
        most = VALUES_UNROLLED_UP_TO if few else UNROLLED_UP_TO
        name = "unrolled" if model.nv <= most else "rolled"
    return DRIVERS[name](model, prepare(model, dtype))
