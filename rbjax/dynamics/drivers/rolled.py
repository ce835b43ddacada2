"""The rolled driver: a `lax.scan` over the links in depth-first order.

One step is compiled however many links there are. A link's parent is nearly always the previous
link. Branch points are kept in a few slots, each free again after its last child, so the loop
carries no array over links. A free joint's six links come first and are unrolled (the *head*), so
that all other links of a usual robot turn about z.

The cost of a step is its reads and writes. So constants are one row, a hinge stores only its cosine
and sine, and neither a link's pose nor a value that a step passes on unchanged is written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers.contract import Step, Sweeps
from rbjax.dynamics.drivers.joint_lanes import joint_columns, joint_lanes
from rbjax.dynamics.drivers.packing import pack
from rbjax.joints import JointMotion, PosedJoint
from rbjax.lanes import Lane, add, as_arrays, fusion_barrier, is_literal
from rbjax.lanes.primitives import whole_cotangent
from rbjax.model import WORLD, Model, Prepared
from rbjax.model.cells import lane_of


class Values:
    """A per-link value of `Rolled`: a list for the head, columns for the rest of the links."""

    def __init__(self, head: list, rest: Any):
        self.head, self.rest = head, rest


jax.tree_util.register_pytree_node(
    Values, lambda v: ((v.head, v.rest), None), lambda _, children: Values(*children)
)


class Constants:
    """Among the columns of `Rolled`: the links' constants."""


class Joints:
    """Among the columns of `Rolled`: joint motions, made by `make` from these columns."""

    def __init__(self, make: Callable[..., JointMotion], columns: list[Lane]):
        self.make, self.columns = make, columns


class PoseLane:
    """Among the columns of `Rolled`: a lane of a pose, cheaper to recompute than to store."""

    def __init__(self, joints: Joints, k: int):
        self.joints, self.k = joints, k


class Rolled(Sweeps):
    """A scan over the links, after the head."""

    listed = False

    def __init__(self, model: Model, prepared: Prepared):
        top = self.topology = model.topology
        self.prepared = prepared
        n = top.nv
        self.head = 6 if top.joint_kinds[:1] == ("free",) and n > 6 else 0
        self._columns = jax.tree.map(lambda x: _uniform(x[self.head :]), prepared.columns)
        self.constants = Values([prepared.link(i) for i in range(self.head)], Constants())
        #: links in one iteration: two save copies of the carry, and double the program
        self.unroll = 1
        self._like: Any = None  # the shape and dtype of one lane, known with q
        parents = np.array(top.parents)
        self._slots, self._slot_of = allocate_slots(top.parents)
        chained = parents == np.arange(n) - 1
        #: the slot from which each link takes its parent, or -1 for the link before
        source = np.where(chained, -1, [self._slot_of.get(p, -1) for p in parents])
        #: the slot in which each link waits for its later children, or -1
        keep = np.array([self._slot_of.get(i, -1) for i in range(n)])
        target = np.where(parents == WORLD, -2, source)
        self._index = np.stack([source, keep, target], 1).astype(np.int32)[self.head :]

    def joints(self, q: jax.Array, v: jax.Array | None) -> Values:
        """The joint motion of each link."""
        self._like = jnp.zeros(q.shape[1:], q.dtype)
        qs: Any = q
        vs: Any = [0.0] * self.topology.nv if v is None else v
        links = enumerate(self.topology.dofs[: self.head])
        head = [joint_lanes(link, self.constants.head[i], qs, vs) for i, link in links]
        make, columns = joint_columns(self.topology, self.prepared, q, v, self.head)
        head, columns = fusion_barrier((head, columns))
        return Values(head, Joints(make, columns))

    def lanes(self, x: jax.Array | None) -> Values:
        """An array (nv, ...) as a per-link lane; zeros if None."""
        if x is None:
            return Values([0.0] * self.head, 0.0)
        return Values([x[i] for i in range(self.head)], x[self.head :])

    def scattered(self, values: Mapping[int, Any], zero: Any) -> Values:
        """As `Unrolled.scattered`."""
        head = [values.get(i, zero) for i in range(self.head)]
        rest = [values.get(i, zero) for i in range(self.head, self.topology.nv)]
        return Values(head, jax.tree.map(self._column, *rest))

    def _column(self, *lanes: Lane) -> Lane:
        """Lanes as a column; a literal if all are the same."""
        if is_literal(lanes[0]) and all(is_literal(x) and x == lanes[0] for x in lanes):
            return lanes[0]
        return jnp.stack(as_arrays(list(lanes), self._like))

    def pack(self, lanes: Values, like: jax.Array) -> jax.Array:
        """A per-link lane as an array (nv, ...)."""
        rest = jnp.broadcast_to(jnp.asarray(lanes.rest, like.dtype), like[self.head :].shape)
        if not self.head:
            return rest
        return jnp.concatenate([pack(lanes.head, like), rest])

    def whole(self, values: Values) -> Any:
        """As `Unrolled.whole`: columns."""
        if isinstance(values.rest, Constants):
            return jax.tree.map(lambda x: self._cast(_uniform(x)), self.prepared.columns)
        return self.columns(values, jnp.zeros(self.topology.nv, self._like.dtype))

    def rows(self, whole: Any) -> Values:
        """As `Unrolled.rows`."""
        head = [_row(whole, i) for i in range(self.head)]
        return Values(head, _row(whole, slice(self.head, None)))

    def each(self, f: Callable, *whole: Any) -> Any:
        """As `Unrolled.each`."""
        return fusion_barrier(f(*whole), known=whole)

    def take(self, whole: Any, index: Sequence[int], world: Any = None) -> Any:
        """As `Unrolled.take`."""
        places = np.array(index, int)
        if np.array_equal(places, np.arange(self.topology.nv)):
            return whole
        outside = places == WORLD
        found = _row(whole, np.maximum(places, 0))
        return _select(outside, world, found) if outside.any() else found

    def stack(self, whole: Any, lanes: Callable, like: jax.Array) -> jax.Array:
        """As `Unrolled.stack`."""
        columns = [jnp.asarray(x, like.dtype) for x in lanes(whole)]
        size = max((x.shape[0] for x in columns if x.ndim), default=self.topology.nv)
        return jnp.stack([jnp.broadcast_to(x, (size,)) for x in columns], -1)

    def known(self, numbers: list[float]) -> Lane:
        """As `Unrolled.known`."""
        return self._cast(_uniform(np.array(numbers)))

    def _cast(self, x: Any) -> Lane:
        return x if is_literal(x) else jnp.asarray(x, self._like.dtype)

    def columns(self, values: Values, like: jax.Array) -> Any:
        """As `Unrolled.columns`."""
        rest = jax.tree.map(self._whole, values.rest)
        return jax.tree.map(lambda r, *h: self.pack(Values(list(h), r), like), rest, *values.head)

    def _whole(self, x: Any) -> Any:
        """A pose's lane computed for all links."""
        if not isinstance(x, PoseLane):
            return x
        pose = x.joints.make(*x.joints.columns).transform(self._columns)
        return jax.tree.leaves(pose)[x.k]

    def zip(self, *values: Values) -> Values:
        """Per-link tuples of per-link values."""
        head = [tuple(v.head[i] for v in values) for i in range(self.head)]
        return Values(head, tuple(v.rest for v in values))

    def part(self, values: Values, k: int) -> Values:
        """As `Unrolled.part`."""
        return Values([x[k] for x in values.head], values.rest[k])

    def outward(self, step: Step, root: Any, xs: Values) -> Values:
        """As `Unrolled.outward`."""
        carries: list = []
        ys: list = []
        for i in range(self.head):
            before = carries[-1] if i else root
            carry, y = fusion_barrier(step(xs.head[i], before), known=(xs.head[i], before))
            carries.append(carry)
            ys.append(y)
        before = as_arrays(carries[-1] if self.head else root, self._like)
        waiting = [as_arrays(root, self._like)] * self._slots
        for i, carry in enumerate(carries):
            if i in self._slot_of:
                waiting[self._slot_of[i]] = as_arrays(carry, self._like)

        def body(carry, index, x):
            before, slots = carry
            parent = before
            for k, slot in enumerate(slots):
                parent = _select(index[0] == k, slot, parent)
            own, y = step(x, parent)
            own = as_arrays(own, self._like)
            slots = tuple(_select(index[1] == k, own, slot) for k, slot in enumerate(slots))
            return (own, slots), y

        _, rest = self._scan(body, (before, tuple(waiting)), xs.rest, reverse=False)
        return Values(ys, rest)

    def inward(self, step: Step, zero: Any, xs: Values) -> Values:
        """As `Unrolled.inward`."""
        nothing = as_arrays(zero, self._like)
        # the first link's message goes to the head, if there is one
        chain = (self._index[0 if self.head else 1 :, 2] == -1).all()

        def body(carry, index, x):
            total, slots = carry
            for k, slot in enumerate(slots):
                total = jax.tree.map(add, total, _select(index[1] == k, slot, nothing))
            message, y = step(x, total)
            message = as_arrays(message, self._like)
            slots = tuple(
                jax.tree.map(
                    add,
                    _select(index[1] == k, nothing, slot),
                    _select(index[2] == k, message, nothing),
                )
                for k, slot in enumerate(slots)
            )
            return (message if chain else _select(index[2] == -1, message, nothing), slots), y

        carry = (nothing, (nothing,) * self._slots)
        (total, slots), rest = self._scan(body, carry, xs.rest, reverse=True)
        ys: list = [None] * self.head
        for i in reversed(range(self.head)):
            if i in self._slot_of:
                total = jax.tree.map(add, total, slots[self._slot_of[i]])
            total, ys[i] = fusion_barrier(step(xs.head[i], total), known=(xs.head[i], total))
        return Values(ys, rest)

    def _scan(self, body, carry, xs, *, reverse: bool) -> tuple[Any, Any]:
        """`lax.scan` over the columns of xs. Literals and known values are not written."""
        leaves, treedef = jax.tree.flatten(xs)
        dtype = self._like.dtype
        numbers, of_constants = jax.tree.flatten(self._columns)
        row = jnp.stack([jnp.asarray(x, dtype) for x in numbers if not is_literal(x)], 1)
        columns: dict[int, Any] = {}
        for x in leaves:
            joints = x.joints if isinstance(x, PoseLane) else x
            for column in joints.columns if isinstance(joints, Joints) else [x]:
                if not (is_literal(column) or isinstance(column, Constants)):
                    columns[id(column)] = column
        emitted: dict[str, Any] = {}

        def scanned(carry, x):
            index, row, lanes = x
            lane_of = dict(zip(columns, lanes, strict=True))
            known = {id(lane): columns[key] for key, lane in lane_of.items()}
            left = iter([row[k] for k in range(row.shape[0])])
            constants = jax.tree.unflatten(
                of_constants, [a if is_literal(a) else next(left) for a in numbers]
            )
            posed: dict[int, PosedJoint] = {}

            def joint(joints):
                if id(joints) not in posed:
                    motion = joints.make(*(lane_of.get(id(c), c) for c in joints.columns))
                    posed[id(joints)] = PosedJoint(motion, constants)
                    for k, lane in enumerate(jax.tree.leaves(posed[id(joints)].pose)):
                        known.setdefault(id(lane), PoseLane(joints, k))
                return posed[id(joints)]

            def value(x):
                if isinstance(x, Constants):
                    return constants
                if isinstance(x, Joints):
                    return joint(x)
                if isinstance(x, PoseLane):
                    return jax.tree.leaves(joint(x.joints).pose)[x.k]
                return lane_of.get(id(x), x)

            given = jax.tree.unflatten(treedef, [value(x) for x in leaves])
            carry, y = body(carry, index, given)
            out, emitted["tree"] = jax.tree.flatten(y)
            emitted["known"] = [a if is_literal(a) else known.get(id(a)) for a in out]
            return fusion_barrier(
                (carry, [a for a, k in zip(out, emitted["known"], strict=True) if k is None])
            )

        given = (jnp.asarray(self._index), row, list(columns.values()))
        carry, ys = jax.lax.scan(scanned, carry, given, reverse=reverse, unroll=self.unroll)
        fresh = map(whole_cotangent, ys)
        out = [next(fresh) if a is None else a for a in emitted["known"]]
        return carry, jax.tree.unflatten(emitted["tree"], out)


def _row(columns: Any, i: Any) -> Any:
    return jax.tree.map(lambda column: column if is_literal(column) else column[i], columns)


def _select(condition, a, b):
    return jax.tree.map(lambda x, y: jnp.where(condition, x, y), a, b)


def _uniform(column):
    """A literal if all entries of a concrete column are zero (or one)."""
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
    """The number of slots, and the slot of each link with a child that does not follow directly."""
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
