"""Drivers: how a recursion over the tree runs.

A recursion is written once, as a step on the lanes of one link; a driver walks the tree with it:

- `Unrolled` writes the steps one after another into the program. Structural zeros differ from link
  to link, so this is the least arithmetic and the fastest code; compile time grows with the tree.
- `Rolled` is a `lax.scan` over the links in depth-first order. One step is compiled however many
  links there are. A link's parent is nearly always the link before; branch points wait in a few
  slots, reused as soon as their last child has passed, so no array over links is carried.

`outward` hands each step its parent's carry, `inward` the sum of its children's messages.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.joints import JointMotion, joint_columns, joint_lanes
from rbjax.dynamics.packing import pack, unpack
from rbjax.lanes import Lane, add, as_arrays, is_literal
from rbjax.materialize import materialize
from rbjax.model import WORLD, LinkConstants, Model, Prepared, prepare
from rbjax.model.cells import lane_of

Step = Callable[[Any, Any], tuple[Any, Any]]

#: above this many velocity coordinates "auto" rolls: at 7 unrolled code is the faster on the
#: CPU (benchmarks/results/cpu-forms-*.json), beyond it the compile time of gradients decides
UNROLLED_UP_TO = 8


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

    def zip(self, *values: list) -> list[tuple]:
        """Per-link tuples of per-link values."""
        return list(zip(*values, strict=True))

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


class Rolled:
    """A scan over the links. Per-link values are pytrees of columns (nv, ...)."""

    def __init__(self, model: Model, prepared: Prepared):
        self.topology, self.prepared = model.topology, prepared
        self.constants: LinkConstants = jax.tree.map(_uniform, prepared.columns)
        self._like: Any = None  # the shape and dtype of one lane, known with q
        parents = np.array(self.topology.parents)
        n = len(parents)
        self._slots, slot_of = allocate_slots(self.topology.parents)
        chained = parents == np.arange(n) - 1
        #: the slot from which each link takes its parent, or -1 for the link before
        self._source = np.where(chained, -1, [slot_of.get(p, -1) for p in parents])
        #: the slot in which each link waits for its later children, or -1
        self._keep = np.array([slot_of.get(i, -1) for i in range(n)])
        self._to_root = parents == WORLD
        self._root_slot = slot_of.get(WORLD)

    def joints(self, q: jax.Array, v: jax.Array | None) -> JointMotion:
        """The joint motions as columns."""
        self._like = jnp.zeros(q.shape[1:], q.dtype)
        return materialize(joint_columns(self.topology, self.prepared, q, v))

    def lanes(self, x: jax.Array | None) -> Lane:
        """An array (nv, ...) as a column; zero if None."""
        return 0.0 if x is None else x

    def pack(self, lanes: Lane, like: jax.Array) -> jax.Array:
        """A column as an array (nv, ...)."""
        return jnp.broadcast_to(jnp.asarray(lanes, like.dtype), like.shape)

    def columns(self, values: Any, like: jax.Array) -> Any:
        """As `Unrolled.columns`: broadcast what is literal."""
        return jax.tree.map(lambda lanes: self.pack(lanes, like), values)

    def zip(self, *values: Any) -> tuple:
        """Columns side by side."""
        return values

    def outward(self, step: Step, root: Any, xs: Any) -> Any:
        """As `Unrolled.outward`, with columns for the y."""
        root = as_arrays(root, self._like)
        slots = tuple(root for _ in range(self._slots))

        def body(carry, index, x):
            before, slots = carry
            source, keep = index
            parent = before
            for k, slot in enumerate(slots):
                parent = _select(source == k, slot, parent)
            own, y = step(x, parent)
            own = as_arrays(own, self._like)
            slots = tuple(_select(keep == k, own, slot) for k, slot in enumerate(slots))
            return (own, slots), y

        return self._scan(body, (root, slots), (self._source, self._keep), xs, reverse=False)

    def inward(self, step: Step, zero: Any, xs: Any) -> Any:
        """As `Unrolled.inward`, with columns for the y."""
        zero = as_arrays(zero, self._like)
        slots = tuple(zero for _ in range(self._slots))
        target = np.where(self._to_root, -2, self._source)

        def body(carry, index, x):
            total, slots = carry
            target, keep = index
            for k, slot in enumerate(slots):
                total = jax.tree.map(add, total, _select(keep == k, slot, zero))
            message, y = step(x, total)
            message = as_arrays(message, self._like)
            slots = tuple(
                jax.tree.map(
                    add,
                    _select(keep == k, zero, slot),
                    _select(target == k, message, zero),
                )
                for k, slot in enumerate(slots)
            )
            if (self._source[1:] == -1).all():
                return (message, slots), y
            return (_select(target == -1, message, zero), slots), y

        return self._scan(body, (zero, slots), (target, self._keep), xs, reverse=True)

    def _scan(self, body, carry, index, xs, *, reverse: bool) -> Any:
        """`lax.scan` over links in which literal lanes of x and y stay literal."""
        leaves, treedef = jax.tree.flatten(xs)
        literal = [is_literal(x) for x in leaves]
        dtype = self._like.dtype
        columns = [jnp.asarray(x, dtype) for x, lit in zip(leaves, literal, strict=True) if not lit]
        emitted: dict[str, Any] = {}

        def scanned(carry, row):
            index, rest = row[0], iter(row[1])
            x = [a if lit else next(rest) for a, lit in zip(leaves, literal, strict=True)]
            after = body(carry, index, jax.tree.unflatten(treedef, x))
            carry, y = materialize(after, known=(carry, x))
            out, emitted["tree"] = jax.tree.flatten(y)
            emitted["literals"] = [a if is_literal(a) else None for a in out]
            return carry, [a for a in out if not is_literal(a)]

        rows = (tuple(jnp.asarray(i, jnp.int32) for i in index), columns)
        _, ys = jax.lax.scan(scanned, carry, rows, reverse=reverse)
        rest = iter(ys)
        out = [next(rest) if a is None else a for a in emitted["literals"]]
        return jax.tree.unflatten(emitted["tree"], out)


Driver = Any  # Unrolled or Rolled; per-link values are lists or columns accordingly
DRIVERS: dict[str, type[Unrolled] | type[Rolled]] = {"unrolled": Unrolled, "rolled": Rolled}


def driver(model: Model, dtype: Any) -> Driver:
    """The driver that the model asks for; "auto" unrolls small trees and rolls large ones."""
    name = model.driver
    if name == "auto":
        name = "unrolled" if model.nv <= UNROLLED_UP_TO else "rolled"
    return DRIVERS[name](model, prepare(model, dtype))


def _select(condition, a, b):
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _uniform(column):
    """A literal where a concrete column is zero (or one) all along."""
    if isinstance(column, np.ndarray) and column.dtype == object:
        lanes = [lane_of(x) for x in column]
        if lanes and all(is_literal(x) and x == lanes[0] and x in (0.0, 1.0) for x in lanes):
            return lanes[0]
        return jnp.stack([jnp.asarray(x) for x in lanes])
    if isinstance(column, np.ndarray) and len(column):
        for value in (0.0, 1.0):
            if (column == value).all():
                return value
    return column


def allocate_slots(parents: tuple[int, ...]) -> tuple[int, dict[int, int]]:
    """The number of slots, and the slot of each link that has a child not right after it."""
    last: dict[int, int] = {}
    for i, parent in enumerate(parents):
        if parent != i - 1:
            last[parent] = i
    free: list[int] = []
    busy: list[tuple[int, int]] = []  # (last child, slot)
    count, slot_of = 0, {}
    for point in sorted(last):
        for item in [b for b in busy if b[0] <= point]:
            busy.remove(item)
            free.append(item[1])
        if not free:
            free.append(count)
            count += 1
        slot_of[point] = free.pop()
        busy.append((last[point], slot_of[point]))
    return count, slot_of
