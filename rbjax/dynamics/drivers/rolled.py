"""The rolled driver: a `lax.scan` over the links in depth-first order.

One step is compiled for any number of links. The parent of a link is nearly always the previous
link. Links with more children are kept in a few slots, which are reused after their last child, so
the loop carries no array over links. The six links of a free joint come first and are unrolled (the
*head*), so that all other links of a usual robot are hinges.

The cost of a step is its reads and writes. Therefore the constants of a link are one row, a hinge
stores only its cosine and sine, and neither poses nor values that a step returns unchanged are
written.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers.contract import Driver, Step, dof_motion
from rbjax.dynamics.drivers.loop import Constants, Iteration, JointColumns, Parts, PoseLane, loop
from rbjax.joints import (
    HINGE,
    SLIDE,
    DofKind,
    JointMotion,
    NodeMotion,
    PosedJoint,
    hinge_motion,
)
from rbjax.lanes import (
    Lane,
    Vec3,
    add,
    as_arrays,
    fusion_barrier,
    is_literal,
    pack,
    rotation_z,
    sincos,
)
from rbjax.lanes.arrays import select
from rbjax.lanes.primitives import whole_cotangent
from rbjax.model import WORLD, Model, ModelConstants, Topology
from rbjax.model.cells import lane_of, stacked
from rbjax.spatial import Motion


class Rolled(Driver):
    """The driver that runs a scan over the links, after the unrolled head."""

    listed = False

    def __init__(self, model: Model, prepared: ModelConstants):
        top = self.topology = model.topology
        self.prepared = prepared
        n = top.nv
        self.head = 6 if top.joint_kinds[:1] == ("free",) and n > 6 else 0
        self._columns = jax.tree.map(lambda x: _uniform(x[self.head :]), prepared.columns)
        self.constants = Parts([prepared.link(i) for i in range(self.head)], Constants())
        self._like: Any = None  # an array with the shape and dtype of one lane; set from q
        parents = np.array(top.parents)
        self._slots, self._slot_of = allocate_slots(top.parents)
        chained = parents == np.arange(n) - 1
        #: the slot of the parent of each link, or -1 if the parent is the previous link
        source = np.where(chained, -1, [self._slot_of.get(p, -1) for p in parents])
        #: the slot in which each link is kept for its later children, or -1
        keep = np.array([self._slot_of.get(i, -1) for i in range(n)])
        target = np.where(parents == WORLD, -2, source)
        self._index = np.stack([source, keep, target], 1).astype(np.int32)[self.head :]

    def joints(self, q: jax.Array, v: jax.Array | None, *along: jax.Array) -> Parts:
        self._like = jnp.zeros(q.shape[1:], q.dtype)
        qs: Any = q
        vs: Any = [0.0] * self.topology.nv if v is None else v
        dofs = enumerate(self.topology.dofs[: self.head])
        head = [dof_motion(dof, self.constants.trunk[i], qs, vs) for i, dof in dofs]
        make, columns = joint_columns(self.topology, self.prepared, q, v, self.head)
        head, columns = fusion_barrier((head, columns))

        def posed(lane_of: Callable[[Any], Lane]) -> PosedJoint:
            return PosedJoint(make(*map(lane_of, columns)), lane_of(Constants()))

        return Parts(head, JointColumns(posed, columns))

    def lanes(self, x: jax.Array | None, links: Sequence[int] | None = None) -> Parts:
        if x is None:
            return Parts([0.0] * self.head, 0.0)
        if links is not None:
            return self.scattered(dict(zip(links, x, strict=True)), 0.0)
        return Parts([x[i] for i in range(self.head)], x[self.head :])

    def scattered(self, values: Mapping[int, Any], zero: Any) -> Parts:
        head = [values.get(i, zero) for i in range(self.head)]
        rest = [values.get(i, zero) for i in range(self.head, self.topology.nv)]
        return Parts(head, jax.tree.map(self._column, *rest))

    def _column(self, *lanes: Lane) -> Lane:
        """Convert lanes to a column, or to a literal if all are the same literal."""
        if is_literal(lanes[0]) and all(is_literal(x) and x == lanes[0] for x in lanes):
            return lanes[0]
        return jnp.stack(as_arrays(list(lanes), self._like))

    def pack(self, lanes: Parts, like: jax.Array, links: Sequence[int] | None = None) -> jax.Array:
        if links is not None:
            return self.pack(lanes, like)[np.array(links)]
        rest = jnp.broadcast_to(jnp.asarray(lanes.rest, like.dtype), like[self.head :].shape)
        if not self.head:
            return rest
        return jnp.concatenate([pack(lanes.trunk, like), rest])

    def whole(self, values: Parts) -> Any:
        if isinstance(values.rest, Constants):
            return jax.tree.map(lambda x: self._cast(_uniform(x)), self.prepared.columns)
        return self.columns(values, jnp.zeros(self.topology.nv, self._like.dtype))

    def rows(self, whole: Any) -> Parts:
        head = [_row(whole, i) for i in range(self.head)]
        return Parts(head, _row(whole, slice(self.head, None)))

    def each(self, f: Callable, *whole: Any) -> Any:
        return fusion_barrier(f(*whole), known=whole)

    def take(self, whole: Any, index: Sequence[int], world: Any = None) -> Any:
        places = np.array(index, int)
        if np.array_equal(places, np.arange(self.topology.nv)):
            return whole
        outside = places == WORLD
        found = _row(whole, np.maximum(places, 0))
        return select(outside, world, found) if outside.any() else found

    def stack(self, whole: Any, lanes: Callable, like: jax.Array) -> jax.Array:
        columns = [jnp.asarray(x, like.dtype) for x in lanes(whole)]
        size = max((x.shape[0] for x in columns if x.ndim), default=self.topology.nv)
        return jnp.stack([jnp.broadcast_to(x, (size,)) for x in columns], -1)

    def literals(self, numbers: list[float]) -> Lane:
        return self._cast(_uniform(np.array(numbers)))

    def _cast(self, x: Any) -> Lane:
        return x if is_literal(x) else jnp.asarray(x, self._like.dtype)

    def columns(self, values: Parts, like: jax.Array) -> Any:
        rest = jax.tree.map(self._whole, values.rest)
        return jax.tree.map(lambda r, *h: self.pack(Parts(list(h), r), like), rest, *values.trunk)

    def _whole(self, x: Any) -> Any:
        """Return a column of values. A `PoseLane` is computed from the joint motions."""
        if not isinstance(x, PoseLane):
            return x
        return x.of(x.joint.posed(lambda c: self._columns if isinstance(c, Constants) else c))

    def zip(self, *values: Parts) -> Parts:
        head = [tuple(v.trunk[i] for v in values) for i in range(self.head)]
        return Parts(head, tuple(v.rest for v in values))

    def part(self, values: Parts, k: int) -> Parts:
        return Parts([x[k] for x in values.trunk], values.rest[k])

    def outward(self, step: Step, root: Any, xs: Parts) -> Parts:
        carries: list = []
        ys: list = []
        for i in range(self.head):
            before = carries[-1] if i else root
            carry, y = fusion_barrier(step(xs.trunk[i], before), known=(xs.trunk[i], before))
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
                parent = select(index[0] == k, slot, parent)
            own, y = step(x, parent)
            own = as_arrays(own, self._like)
            slots = tuple(select(index[1] == k, own, slot) for k, slot in enumerate(slots))
            return (own, slots), y

        _, rest = self._scan(body, (before, tuple(waiting)), xs.rest, reverse=False)
        return Parts(ys, rest)

    def inward(self, step: Step, zero: Any, xs: Parts) -> Parts:
        nothing = as_arrays(zero, self._like)
        # the message of the first link goes to the head, if there is one
        chain = (self._index[0 if self.head else 1 :, 2] == -1).all()

        def body(carry, index, x):
            total, slots = carry
            for k, slot in enumerate(slots):
                total = jax.tree.map(add, total, select(index[1] == k, slot, nothing))
            message, y = step(x, total)
            message = as_arrays(message, self._like)
            slots = tuple(
                jax.tree.map(
                    add,
                    select(index[1] == k, nothing, slot),
                    select(index[2] == k, message, nothing),
                )
                for k, slot in enumerate(slots)
            )
            return (message if chain else select(index[2] == -1, message, nothing), slots), y

        carry = (nothing, (nothing,) * self._slots)
        (total, slots), rest = self._scan(body, carry, xs.rest, reverse=True)
        ys: list = [None] * self.head
        for i in reversed(range(self.head)):
            if i in self._slot_of:
                total = jax.tree.map(add, total, slots[self._slot_of[i]])
            total, ys[i] = fusion_barrier(step(xs.trunk[i], total), known=(xs.trunk[i], total))
        return Parts(ys, rest)

    def _scan(self, body: Callable, carry: Any, xs: Any, *, reverse: bool) -> tuple[Any, Any]:
        """Scan carry, y = body(carry, index, x) over the links, with x from the columns `xs`."""
        dtype = self._like.dtype
        numbers, of_constants = jax.tree.flatten(self._columns)
        rows = jnp.stack([jnp.asarray(x, dtype) for x in numbers if not is_literal(x)], 1)

        def scan(step: Callable, carry: Any, columns: list) -> tuple[Any, Any]:
            def scanned(carry, x):
                index, row, lanes = x
                left = iter([row[k] for k in range(row.shape[0])])
                constants = [a if is_literal(a) else next(left) for a in numbers]
                more = index, jax.tree.unflatten(of_constants, constants)
                return fusion_barrier(step(carry, (more, lanes)))

            given = (jnp.asarray(self._index), rows, columns)
            carry, ys = jax.lax.scan(scanned, carry, given, reverse=reverse, unroll=self.unroll)
            return carry, list(map(whole_cotangent, ys))

        def with_index(carry: Any, x: Any, more: tuple, _: Iteration) -> tuple[Any, Any]:
            return body(carry, more[0], x)

        return loop(scan, with_index, carry, xs)


def _row(columns: Any, i: Any) -> Any:
    return jax.tree.map(lambda column: column if is_literal(column) else column[i], columns)


def _uniform(column):
    """Replace a concrete column of zeros, or of ones, by a literal."""
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
    """Return the number of slots, and the slot of each link that needs one.
    A link needs a slot if one of its children is not the next link."""
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


def joint_columns(
    top: Topology, prepared: ModelConstants, q: jax.Array, v: jax.Array | None, start: int = 0
) -> tuple[Callable[..., JointMotion], list[Lane]]:
    """Return a function that computes a `JointMotion`, and the columns that are its arguments.

    Each column (nv - start, ...) has one entry for each link from `start` on. The function also
    accepts the entries of one link.
    """
    links = top.dofs[start:]
    batch = (1,) * (q.ndim - 1)

    def mask(flags):
        return np.array(list(flags), bool).reshape(-1, *batch)

    hinge = mask(link.kind is HINGE for link in links)
    slide = mask(link.kind is SLIDE for link in links)
    places = np.array([link.q[0] if len(link.q) else 0 for link in links])
    reference = prepared.columns.reference[start:].reshape(-1, *batch)
    at = q[places] - stacked(reference, q.dtype)
    v = None if v is None else v[start:]
    qd = 0.0 if v is None else v
    if hinge.all():
        return hinge_motion, [*sincos(at), qd]
    J = rotation_z(*sincos(jnp.where(hinge, at, 0.0)))
    rate = Vec3.zero() if v is None else Vec3(0.0, 0.0, jnp.where(hinge, v, 0.0))
    S = HINGE.axis(())
    moves: Lane = 0.0
    if slide.any():
        turns = jnp.asarray(~slide, q.dtype)
        S = Motion(Vec3(0.0, 0.0, turns), Vec3(0.0, 0.0, 1 - turns))
        moves = jnp.where(slide, at, 0.0)
    motion = JointMotion(J, Vec3(0.0, 0.0, moves), S, rate, qd)
    varying = not all(link.kind.constant_axis for link in links)
    general = NodeMotion.of if varying else lambda motion: motion
    motion = general(motion)

    def with_kind(motion: JointMotion, kind: DofKind, rows: np.ndarray) -> JointMotion:
        """Compute the rows of one kind of dof, and put them into the motion."""
        some = [links[i] for i in rows]
        qs = [q[np.array(of)] for of in zip(*(link.q for link in some), strict=True)]
        vs = [
            0.0 if v is None else v[np.array(of) - start]
            for of in zip(*(link.v for link in some), strict=True)
        ]
        constants = jax.tree.map(
            lambda x: stacked(x[rows + start].reshape(-1, *batch), q.dtype), prepared.columns
        )
        own = kind.motion(qs, vs, constants)
        return jax.tree.map(lambda column, x: _insert(column, rows, x, at), motion, general(own))

    # replace the rows of all other kinds, except dofs that are rigid to the previous dof
    others: dict[DofKind, list[int]] = {}
    for i, link in enumerate(links):
        if link.kind not in (HINGE, SLIDE) and not link.kind.rigid_to_previous:
            others.setdefault(link.kind, []).append(i)
    for kind, rows in others.items():
        motion = with_kind(motion, kind, np.array(rows))
    leaves, treedef = jax.tree.flatten(motion)
    return lambda *lanes: jax.tree.unflatten(treedef, lanes), leaves


def _insert(column: Lane, rows: np.ndarray, values: Lane, like: jax.Array) -> Lane:
    if is_literal(column) and is_literal(values) and column == values:
        return column
    wide = jnp.broadcast_to(jnp.asarray(column, like.dtype), like.shape)
    return wide.at[rows].set(values)
