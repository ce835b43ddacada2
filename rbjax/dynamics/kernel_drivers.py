"""Drivers inside a Pallas kernel: the same steps on one block of the batch.

- `KernelUnrolled` writes the links out; everything lives in registers. For few links.
- `KernelRolled` is a loop over the links. A link's lanes wait in rows of `memory`, an extra output
  that the kernel uses as scratch; constants and parents are read by index. What a step hands on
  unchanged is not written again, and transforms are computed again rather than kept: the loop is
  bound by its traffic. Links of a floating base come first and are written out (the *head*).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl

from rbjax.dynamics.drivers import Unrolled, allocate_slots
from rbjax.dynamics.joints import JointMotion, joint_lanes
from rbjax.dynamics.kernel_numbers import Numbers
from rbjax.lanes import Lane, Vec3, add, as_arrays, is_literal, rotation_z
from rbjax.materialize import sincos
from rbjax.model import WORLD, LinkConstants
from rbjax.spatial import Motion, Transform

#: rows of a slot: the widest message
SLOT = 33
_HINGE = Motion(Vec3(0.0, 0.0, 1.0), Vec3.zero())


class KernelUnrolled(Unrolled):
    """`Unrolled` on lists of lanes."""

    def __init__(self, known: Numbers):
        self.topology, self.prepared = known.model.topology, known.prepared
        self.constants = [known.prepared.link(i)() for i in range(self.topology.nv)]

    def joints(self, q: list[Lane], v: list[Lane]) -> list[JointMotion]:
        links = enumerate(self.topology.links)
        return [joint_lanes(link, self.constants[i], q, v, i) for i, link in links]

    def lanes(self, x: list[Lane]) -> list[Lane]:
        return x

    def pack(self, lanes: list[Lane], like: Any) -> list[Lane]:
        return lanes


class Memory:
    """Rows of a block's width in an array (rows, width of all blocks)."""

    def __init__(self, ref: Any, columns: Any, like: jax.Array):
        self.ref, self.columns, self.like, self.used = ref, columns, like, 0

    def take(self, count: int) -> int:
        """The first of `count` fresh rows."""
        self.used += count
        assert self.used <= self.ref.shape[0], "too few rows of scratch"
        return self.used - count

    def read(self, row: Any) -> jax.Array:
        return self.ref[row, self.columns]

    def write(self, row: Any, x: Lane) -> None:
        self.ref[row, self.columns] = as_arrays(x, self.like)


class Cell:
    """Where a lane of a per-link value is: a literal, a row, or a lane of the joint itself."""

    def __init__(self, literal: Any = None, row: int | None = None, joint: int | None = None):
        self.literal, self.row, self.joint = literal, row, joint


class Values:
    """A per-link value: cells for each link of the head, and cells by index for the others."""

    def __init__(self, head: list[Any], body: Any):
        self.head, self.body = head, body

    def cells(self, i: int | None) -> Any:
        return self.body if i is None else self.head[i]

    def __iter__(self):
        every = [*self.head, self.body] if self.body is not None else self.head
        for part in zip(*every, strict=True):
            head = list(part[: len(self.head)])
            yield Values(head, part[-1] if self.body is not None else None)


class _Constants:
    """Stands for the link's constants in the x of a step."""


class _Joints:
    """Stands for its joint motion."""


class PosedJoint(JointMotion):
    """A joint motion that gives the link's pose without computing it twice."""

    def transform(self, link: LinkConstants) -> Transform:
        return self.pose  # type: ignore[attr-defined]


class Visit:
    """One link while a step runs on it: what has been read, and where it came from."""

    def __init__(self, d: KernelRolled, i: Any, static: int | None):
        self.d, self.i, self.static = d, i, static
        self.source: dict[int, Cell] = {}
        self._constants: Any = None
        self._joint: Any = None
        self._rows: dict[int, jax.Array] = {}
        self._hold: list[Any] = []

    def constants(self) -> LinkConstants:
        if self._constants is None:
            columns = self.d.columns
            if self.static is not None:
                self._constants = self.d.prepared.link(self.static)()
            else:
                self._constants = jax.tree.map(self._number, columns)
        return self._constants

    def _number(self, column: Any) -> Lane:
        return float(column[0]) if isinstance(column, np.ndarray) else column[self.i]

    def joint(self) -> PosedJoint:
        if self._joint is None:
            link, cells = self.constants(), self.d.motions.cells(self.static)
            if self.static is None:
                c, s, qd = self.load(cells)
                motion = JointMotion(rotation_z(c, s), 0.0, _HINGE, Vec3(0.0, 0.0, qd), qd)
            else:
                motion = self.load(cells)
            posed = PosedJoint(motion.J, motion.slide, motion.S, motion.rate, motion.qd)
            pose = JointMotion.transform(motion, link)
            object.__setattr__(posed, "pose", pose)
            if self.static is None:
                object.__setattr__(posed, "hinge", (c, s, qd))
            self._joint = posed
            for k, x in enumerate(jax.tree.leaves(pose)):
                if not is_literal(x):
                    self.source.setdefault(id(x), Cell(joint=k))
        return self._joint

    def load(self, cells: Any) -> Any:
        """The lanes in the cells."""
        return jax.tree.map(self._one, cells, is_leaf=_special)

    def _one(self, cell: Any) -> Any:
        if isinstance(cell, _Constants):
            return self.constants()
        if isinstance(cell, _Joints):
            return self.joint()
        if cell.joint is not None:
            return jax.tree.leaves(self.joint().pose)[cell.joint]
        if cell.row is None:
            return cell.literal
        if cell.row not in self._rows:
            x = self.d.memory.read(cell.row if self.static is not None else cell.row + self.i)
            self._rows[cell.row] = x
            self.source[id(x)] = cell
        return self._rows[cell.row]

    def store(self, tree: Any) -> Any:
        """Cells that hold the lanes from now on; only what is new is written."""
        return jax.tree.map(self._put, tree)

    def _put(self, x: Lane) -> Cell:
        if is_literal(x):
            return Cell(literal=x)
        if id(x) in self.source:
            return self.source[id(x)]
        d = self.d
        row = d.memory.take(1) if self.static is not None else d.memory.take(d.size) - d.head
        d.memory.write(row if self.static is not None else row + self.i, x)
        self._hold.append(x)
        self.source[id(x)] = cell = Cell(row=row)
        return cell


def _special(x: Any) -> bool:
    return isinstance(x, (Cell, _Constants, _Joints))


class KernelRolled:
    """A loop over the links, after a head that is written out."""

    def __init__(self, known: Numbers, memory: Memory, index: Any):
        self.topology, self.prepared, self.memory = known.model.topology, known.prepared, memory
        self.columns, self.index = known.prepared.columns, index
        self.head, self.slots, _ = layout(self.topology)
        self.size = self.topology.nv - self.head
        self.slot_start = memory.take(SLOT * self.slots)
        self.constants = Values([_Constants()] * self.head, _Constants())
        self.motions: Values = Values([], None)

    # -- joints and plain arrays over the links -------------------------------------------------

    def joints(self, q: Callable, v: Callable, v_row: int | None = None) -> Values:
        """The joint motions; q and v read a coordinate by its index, or v is in rows already."""
        top, n, qs, vs = self.topology, self.head, _Lookup(q), _Lookup(v)
        head = []
        for i in range(n):
            visit = Visit(self, i, i)
            motion = joint_lanes(top.links[i], visit.constants(), qs, vs, i)
            head.append(visit.store(motion))
        rows = [self.memory.take(self.size) - n for _ in range(2 if v_row is not None else 3)]

        def body(i, _):
            visit = Visit(self, i, None)
            angle = q(self.index[1, i])
            reference = visit.constants().reference
            c, s = sincos(angle if is_literal(reference) and not reference else angle - reference)
            self.memory.write(rows[0] + i, c)
            self.memory.write(rows[1] + i, s)
            if v_row is None:
                self.memory.write(rows[2] + i, v(i))
            return 0

        _loop(body, 0, n, top.nv)
        if v_row is not None:
            rows.append(v_row)
        self.motions = Values(head, tuple(Cell(row=row) for row in rows))
        return Values([_Joints()] * n, _Joints())

    def column(self, read: Callable[[Any], jax.Array]) -> Values:
        """Lanes that are read by index, as a per-link value."""
        start = self.memory.take(self.topology.nv)
        _loop(lambda i, _: (self.memory.write(start + i, read(i)), 0)[1], 0, 0, self.topology.nv)
        return self.rows(start)

    def write(self, values: Values, to: Callable[[Any, Lane], None]) -> None:
        """Hand every link's lane to `to(i, lane)`."""
        for i in range(self.head):
            to(i, self.read(values, i))
        body = values.body
        if self.size and body.row is not None:
            n, nv = self.head, self.topology.nv
            _loop(lambda i, _: (to(i, self.memory.read(body.row + i)), 0)[1], 0, n, nv)

    def rows(self, start: int) -> Values:
        """Rows start, start + 1, ... as a per-link value."""
        return Values([Cell(row=start + i) for i in range(self.head)], Cell(row=start))

    def read(self, values: Values, i: int) -> Lane:
        """One link's lane, for a known link."""
        cell = values.head[i] if i < self.head else values.body
        if cell.row is None:
            return cell.literal
        return self.memory.read(cell.row if i < self.head else cell.row + i)

    def zip(self, *values: Values) -> Values:
        heads = [tuple(v.head[i] for v in values) for i in range(self.head)]
        return Values(heads, tuple(v.body for v in values))

    # -- recursions -----------------------------------------------------------------------------

    def _arrays(self, tree: Any) -> Any:
        return as_arrays(tree, self.memory.like)

    def _slot(self, k: Any) -> Any:
        return self.slot_start + SLOT * k

    def _write_slot(self, k: Any, tree: Any) -> None:
        for n, x in enumerate(jax.tree.leaves(tree)):
            self.memory.write(self._slot(k) + n, x)

    def _read_slot(self, k: Any, like: Any) -> Any:
        leaves, treedef = jax.tree.flatten(like)
        found = [self.memory.read(self._slot(k) + n) for n in range(len(leaves))]
        return jax.tree.unflatten(treedef, found)

    def outward(self, step: Callable, root: Any, xs: Values) -> Values:
        """carry_i, y_i = step(x_i, carry of the parent)."""
        top, n = self.topology, self.head
        slot_of = allocate_slots(top.parents)[1]
        root = self._arrays(root)
        if WORLD in slot_of:
            self._write_slot(slot_of[WORLD], root)
        carries, head = [], []
        for i in range(n):
            visit = Visit(self, i, i)
            before = root if top.parents[i] == WORLD else carries[top.parents[i]]
            own, y = step(visit.load(xs.head[i]), before)
            head.append(visit.store(y))
            carries.append(self._arrays(own))
            if i in slot_of:
                self._write_slot(slot_of[i], carries[-1])
        out: dict[str, Any] = {}

        def body(i, before):
            visit = Visit(self, i, None)
            if self.slots:
                source = self.index[2, i]
                before = jax.lax.cond(
                    source >= 0, lambda: self._read_slot(source, before), lambda: before
                )
            own, y = step(visit.load(xs.body), before)
            own = self._arrays(own)
            out["y"] = visit.store(y)
            if self.slots:
                keep = self.index[3, i]

                @pl.when(keep >= 0)
                def _():
                    self._write_slot(keep, own)

            return own

        _loop(body, carries[-1] if n else root, n, top.nv)
        return Values(head, out.get("y"))

    def inward(self, step: Callable, zero: Any, xs: Values) -> Values:
        """message_i, y_i = step(x_i, sum of the children's messages)."""
        top, n = self.topology, self.head
        slot_of = allocate_slots(top.parents)[1]
        nothing = self._arrays(zero)
        out: dict[str, Any] = {}

        def body(k, carry):
            i = top.nv - 1 - k
            visit = Visit(self, i, None)
            total = carry
            if self.slots:
                keep = self.index[3, i]
                waiting = jax.lax.cond(
                    keep >= 0, lambda: self._read_slot(keep, carry), lambda: nothing
                )
                total = jax.tree.map(add, carry, waiting)
            message, y = step(visit.load(xs.body), total)
            message = self._arrays(message)
            out["y"] = visit.store(y)
            if not self.slots:
                return message
            target, first = self.index[4, i], self.index[5, i]

            @pl.when(target >= 0)
            def _():
                before = self._read_slot(target, message)
                before = jax.tree.map(lambda x: jnp.where(first == 1, 0.0, x), before)
                self._write_slot(target, jax.tree.map(add, before, message))

            return jax.tree.map(lambda x: jnp.where(target == -1, x, 0.0), message)

        carry = _loop(body, nothing, 0, self.size)
        sums = [zero] * n
        if n and top.nv > n and top.parents[n] == n - 1:
            sums[n - 1] = carry
        head: list[Any] = [None] * n
        for i in reversed(range(n)):
            visit = Visit(self, i, i)
            total = sums[i]
            if i in slot_of and any(p == i for p in top.parents[max(n, i + 2) :]):
                total = jax.tree.map(add, total, self._read_slot(slot_of[i], nothing))
            message, y = step(visit.load(xs.head[i]), total)
            head[i] = visit.store(y)
            if top.parents[i] != WORLD:
                parent = top.parents[i]
                sums[parent] = jax.tree.map(add, sums[parent], message)
        return Values(head, out.get("y"))


def _loop(body: Callable, carry: Any, start: int, stop: int) -> Any:
    return carry if start == stop else jax.lax.fori_loop(start, stop, body, carry)


class _Lookup:
    """`x[i]` by a function."""

    def __init__(self, read: Callable[[Any], jax.Array]):
        self.read = read

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self.read(k) for k in range(i.start, i.stop)]
        return self.read(i)


def layout(top: Any) -> tuple[int, int, np.ndarray]:
    """Links of the head, slots, and rows by link: parent, q, source, keep, target, first."""
    links, parents = top.links, np.array(top.parents)
    plain = [link.kind == "hinge" and link.part is None for link in links]
    head = max((i + 1 for i, p in enumerate(plain) if not p), default=0)
    slots, slot_of = allocate_slots(top.parents)
    n = len(parents)
    chained = parents == np.arange(n) - 1
    source = np.where(chained, -1, [slot_of.get(p, -1) for p in top.parents])
    keep = np.array([slot_of.get(i, -1) for i in range(n)])
    target = np.where(parents == WORLD, -2, source)
    first = np.zeros(n, int)
    for i in range(n):  # the last child of a branch point comes first on the way in
        if target[i] >= 0 and not any(top.parents[k] == top.parents[i] for k in range(i + 1, n)):
            first[i] = 1
    q = np.array([0 if link.q is None else link.q for link in links])
    return head, slots, np.stack([parents, q, source, keep, target, first]).astype(np.int32)
