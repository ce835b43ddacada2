"""Drivers inside a Pallas kernel: the same steps on one block of the batch.

- `KernelUnrolled` writes the links out; everything lives in registers. For few links.
- `KernelRolled` is a loop over the links. A link's lanes wait in rows of `memory`, an extra output
  that the kernel uses as scratch; constants and parents are read by index. What a step hands on
  unchanged is not written again, and transforms are computed again rather than kept: the loop is
  bound by its traffic. A floating base is no link of the loop but its root (`kernel_base`).

Triton's time to compile grows with the square of the operations written out and with the accesses
to memory (its coalescing pass walks the whole data flow around each of them), so whatever grows
with the tree is a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import pallas as pl

from rbjax.dynamics.drivers import Unrolled
from rbjax.dynamics.joints import JointMotion, PosedJoint, joint_lanes
from rbjax.dynamics.kernel_base import FloatingBase
from rbjax.dynamics.kernel_layout import (
    FIRST,
    KEEP,
    SOURCE,
    TARGET,
    TURNS,
    Q,
    base_links,
    is_plain,
    slots,
)
from rbjax.dynamics.kernel_numbers import Numbers
from rbjax.lanes import Lane, Mat3, Vec3, add, as_arrays, is_literal, rotation_z
from rbjax.materialize import sincos
from rbjax.model import WORLD, LinkConstants
from rbjax.spatial import Motion

#: rows of a slot: the widest message
SLOT = 33
HINGE = Motion(Vec3(0.0, 0.0, 1.0), Vec3.zero())


class KernelUnrolled(Unrolled):
    """`Unrolled` on lists of lanes."""

    base = None

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

    def keep(self, tree: Any) -> Callable[[], Any]:
        """Put the lanes aside; the result reads them back."""
        leaves, treedef = jax.tree.flatten(tree)
        start = self.take(len(leaves))
        for k, x in enumerate(leaves):
            self.write(start + k, x)
        return lambda: jax.tree.unflatten(
            treedef, [self.read(start + k) for k in range(len(leaves))]
        )


class Cell:
    """Where a lane of a per-link value is: a literal, row + i, a function of i, a lane of the
    joint's pose."""

    def __init__(
        self, literal: Any = None, row: Any = None, read: Any = None, joint: int | None = None
    ):
        self.literal, self.row, self.read, self.joint = literal, row, read, joint


class _Constants:
    """Stands for the link's constants in the x of a step."""


class _Joints:
    """Stands for its joint motion."""


class Visit:
    """One link while a step runs on it: what has been read, and where it came from."""

    def __init__(self, d: KernelRolled, i: Any):
        self.d, self.i = d, i
        self.source: dict[int, Cell] = {}
        self._constants: Any = None
        self._joint: Any = None
        self._read: dict[int, jax.Array] = {}
        self._hold: list[Any] = []

    def constants(self) -> LinkConstants:
        if self._constants is None:
            self._constants = jax.tree.map(self._number, self.d.columns)
        return self._constants

    def _number(self, column: Any) -> Lane:
        return float(column[0]) if isinstance(column, np.ndarray) else column[self.i]

    def joint(self) -> PosedJoint:
        if self._joint is None:
            motion = self.load(self.d.motions)
            hinge = None
            if isinstance(motion, tuple):
                c, s, qd = hinge = motion
                motion = JointMotion(rotation_z(c, s), 0.0, HINGE, Vec3(0.0, 0.0, qd), qd)
            self._joint = PosedJoint(motion, self.constants(), hinge)
            for k, x in enumerate(jax.tree.leaves(self._joint.pose)):
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
        if cell.row is None and cell.read is None:
            return cell.literal
        if id(cell) not in self._read:
            x = cell.read(self.i) if cell.row is None else self.d.memory.read(cell.row + self.i)
            self._read[id(cell)] = x
            self.source[id(x)] = cell
        return self._read[id(cell)]

    def store(self, tree: Any) -> Any:
        """Cells that hold the lanes from now on; only what is new is written."""
        return jax.tree.map(self._put, tree)

    def _put(self, x: Lane) -> Cell:
        if is_literal(x):
            return Cell(literal=x)
        if id(x) in self.source:
            return self.source[id(x)]
        memory = self.d.memory
        row = memory.take(self.d.topology.nv)
        memory.write(row + self.i, x)
        self._hold.append(x)
        self.source[id(x)] = cell = Cell(row=row)
        return cell


def _special(x: Any) -> bool:
    return isinstance(x, (Cell, _Constants, _Joints))


class KernelRolled:
    """A loop over the links. Per-link values are pytrees of cells."""

    def __init__(self, known: Numbers, memory: Memory, index: Any):
        self.topology, self.prepared, self.memory = known.model.topology, known.prepared, memory
        self.columns, self.index = known.prepared.columns, index
        self.first = base_links(self.topology)
        self.slots, self.slot_of = slots(self.topology)
        self.plain = all(is_plain(link) for link in self.topology.links[self.first :])
        self.slot_start = memory.take(SLOT * self.slots)
        self.constants, self.motions = _Constants(), None
        #: what arrived at the root on the last way in; the floating base, if any
        self.arrived: Any = None
        self.base: FloatingBase | None = None

    # -- joints and plain arrays over the links -------------------------------------------------

    def joints(self, q: Callable, v: Cell) -> _Joints:
        """The joint motions; q reads a coordinate by its index, v a link's speed."""
        start = self.memory.take(2 * self.topology.nv)
        rows = [start, start + self.topology.nv]

        def body(i, _):
            angle = q(self.index[Q, i])
            reference = Visit(self, i).constants().reference
            c, s = sincos(angle if is_literal(reference) and not reference else angle - reference)
            self.memory.write(rows[0] + i, c)
            self.memory.write(rows[1] + i, s)
            return 0

        loop(body, 0, self.first, self.topology.nv)
        if self.first:
            self.base = FloatingBase(self.prepared, q, lambda i: self.at(v, i))
        self.motions = (Cell(row=rows[0]), Cell(row=rows[1]), v)
        if not self.plain:
            self.motions = self._kinds(q, v, *self.motions[:2])
        return _Joints()

    def _kinds(self, q: Callable, v: Cell, c: Cell, s: Cell) -> JointMotion:
        """Joint motions where joints differ in kind, 14 rows a link: hinges by the loop, what is
        no hinge one by one."""
        top, memory = self.topology, self.memory
        shape = JointMotion(Mat3(*range(9)), 9, HINGE, Vec3(*range(10, 13)), 13)
        rows = [memory.take(top.nv) for _ in range(14)]

        def write(i, motion):
            lanes = [*motion.J, motion.slide, *motion.rate, motion.qd]
            for row, x in zip(rows, lanes, strict=True):
                memory.write(row + i, x)

        def body(i, _):
            cosine, sine, qd = Visit(self, i).load((c, s, v))
            J = rotation_z(cosine, sine)
            write(i, JointMotion(J, 0.0, HINGE, Vec3(0.0, 0.0, qd), qd))
            return 0

        loop(body, 0, self.first, top.nv)
        qs, vs = _Lookup(q), _Lookup(lambda i: self.at(v, i))
        for i in range(self.first, top.nv):
            if not is_plain(top.links[i]):
                write(i, joint_lanes(top.links[i], self.prepared.link(i)(), qs, vs, i))

        def turns(i):
            return self.index[TURNS, i].astype(memory.like.dtype)

        cells = jax.tree.map(lambda k: Cell(row=rows[int(k)]), shape)
        axis = Motion(
            Vec3(*map(Cell, (0.0, 0.0)), Cell(read=turns)),
            Vec3(*map(Cell, (0.0, 0.0)), Cell(read=lambda i: 1.0 - turns(i))),
        )
        return JointMotion(cells.J, cells.slide, axis, cells.rate, cells.qd)

    def write(self, cell: Cell, to: Callable[[Any, Lane], None]) -> None:
        """Hand every link's lane to `to(i, lane)`."""
        loop(lambda i, _: (to(i, self.memory.read(cell.row + i)), 0)[1], 0, 0, self.topology.nv)

    def at(self, cells: Any, i: int) -> Any:
        """One link's lanes."""
        return Visit(self, i).load(cells)

    def joined(self, base: list[Lane], cell: Cell | None) -> Cell:
        """A lane of the links of the loop, with the base's six before it."""
        cell = cell or Cell(row=self.memory.take(self.topology.nv))
        for k, x in enumerate(base):
            self.memory.write(cell.row + k, x)
        return cell

    def zip(self, *values: Any) -> tuple:
        return values

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

    def outward(self, step: Callable, root: Any, xs: Any) -> Any:
        """carry_i, y_i = step(x_i, carry of the parent); root is the carry of the base."""
        root = self._arrays(root)
        waiting = self.slot_of.get(self.first - 1 if self.first else WORLD)
        if waiting is not None:
            self._write_slot(waiting, root)
        if self.first:  # its first limb, too, reads the slot: shorter data flow for Triton to walk
            root = jax.tree.map(jnp.zeros_like, root)
        out: dict[str, Any] = {}

        def body(i, before):
            visit = Visit(self, i)
            if self.slots:
                source = self.index[SOURCE, i]
                before = jax.lax.cond(
                    source >= 0, lambda: self._read_slot(source, before), lambda: before
                )
            own, y = step(visit.load(xs), before)
            own = self._arrays(own)
            out["y"] = visit.store(y)
            if self.slots:
                keep = self.index[KEEP, i]

                @pl.when(keep >= 0)
                def _():
                    self._write_slot(keep, own)

            return own

        loop(body, root, self.first, self.topology.nv)
        return out.get("y")

    def inward(self, step: Callable, zero: Any, xs: Any) -> Any:
        """message_i, y_i = step(x_i, sum of the children's messages)."""
        last = self.topology.nv - 1
        nothing = self._arrays(zero)
        out: dict[str, Any] = {}

        def body(k, carry):
            i = last - k
            visit = Visit(self, i)
            total = carry
            if self.slots:
                keep = self.index[KEEP, i]
                waiting = jax.lax.cond(
                    keep >= 0, lambda: self._read_slot(keep, carry), lambda: nothing
                )
                total = jax.tree.map(add, carry, waiting)
            message, y = step(visit.load(xs), total)
            message = self._arrays(message)
            out["y"] = visit.store(y)
            if not self.slots:
                return message
            target, first = self.index[TARGET, i], self.index[FIRST, i]

            @pl.when(target >= 0)
            def _():
                before = self._read_slot(target, message)
                before = jax.tree.map(lambda x: jnp.where(first == 1, 0.0, x), before)
                self._write_slot(target, jax.tree.map(add, before, message))

            return jax.tree.map(lambda x: jnp.where(target == -1, x, 0.0), message)

        loop(body, nothing, 0, last + 1 - self.first)
        if self.first:
            limbs = last + 1 > self.first
            self.arrived = self._read_slot(self.slot_of[5], nothing) if limbs else nothing
        return out.get("y")


def loop(body: Callable, carry: Any, start: int, stop: int) -> Any:
    """`fori_loop`, or nothing."""
    return carry if start == stop else jax.lax.fori_loop(start, stop, body, carry)


class _Lookup:
    """`x[i]` by a function."""

    def __init__(self, read: Callable[[Any], jax.Array]):
        self.read = read

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self.read(k) for k in range(i.start, i.stop)]
        return self.read(i)
