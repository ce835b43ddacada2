"""Small arrays of the program of one thread.

An array has one of these forms:
    numpy array of numbers: constants.
    numpy array of objects: one `Value` per entry, each in a register.
    `View`: entries in memory. Only this form may be indexed by values that are not constant.
    `Delayed`: entries that are computed when they are read. Used if a team runs the program.

A team is a block of GPU threads that runs one sample together.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.program import row_major
from rbjax.compiler.ir.statements import I32, Array, Value, Var
from rbjax.compiler.lower.delayed import Delayed, Shaped


@dataclass(frozen=True, slots=True, eq=False)
class View(Shaped):
    """A strided view of an array in memory.

    Entry `index` is array[base + offset + sum of index * stride]. `base` is a run-time value, or
    None for 0. `offset` and `strides` are constants, in entries.
    """

    array: Array
    base: Value | None
    offset: int
    strides: tuple[int, ...]
    shape: tuple[int, ...]

    @staticmethod
    def of(array: Array, shape: Sequence[int]) -> View:
        """Return a row-major view of a whole array."""
        return View(array, None, 0, row_major(shape), tuple(shape))

    @property
    def dtype(self) -> np.dtype:
        return self.array.dtype

    @property
    def is_updatable(self) -> bool:
        """Whether this view may be updated in place.

        Its entries must have distinct addresses, and its array must be local and have no other use.
        """
        apart = all(s or n <= 1 for s, n in zip(self.strides, self.shape, strict=True))
        own = self.array.space == "local" and not self.array.write_once
        return apart and own and not self.array.reference_count

    def is_same_view(self, other: object) -> bool:
        """Return whether `other` is a view of the same entries, in the same order."""
        return isinstance(other, View) and all(
            a is b or a == b
            for a, b in (
                (self.array, other.array), (self.base, other.base), (self.offset, other.offset),
                (self._steps(), other._steps()), (self.shape, other.shape),
            )
        )  # fmt: skip

    def _steps(self) -> list[int]:
        """Return the strides of the axes that have more than one entry."""
        return [s for s, n in zip(self.strides, self.shape, strict=True) if n > 1]

    def offsets(self) -> np.ndarray:
        """Return the constant part of the address of each entry."""
        out = np.full(self.shape, self.offset)
        for axis, (n, stride) in enumerate(zip(self.shape, self.strides, strict=True)):
            wide = [-1 if k == axis else 1 for k in range(self.ndim)]
            out += (np.arange(n) * stride).reshape(wide)
        return out

    def at(self, b: Builder, axis: int, index: Value) -> View:
        """Return the slice at an index along an axis. The result lacks this axis."""
        stride = self.strides[axis]
        strides, shape = (
            tuple(x for k, x in enumerate(xs) if k != axis) for xs in (self.strides, self.shape)
        )
        moved = self.shift(b, (index, stride))
        return replace(moved, strides=strides, shape=shape)

    def shift(self, b: Builder, *terms: tuple[Value, int]) -> View:
        """Shift the view by the sum of value * stride over the terms, in entries."""
        known = sum(int(v) * s for v, s in terms if isinstance(v, np.generic))
        unknown = [(v, s) for v, s in terms if not isinstance(v, np.generic)]
        base = b.index(self.array, *unknown)
        if self.base is not None and base is not None:
            base = b.op("index_add", self.array.index, self.base, base)
        return replace(self, base=self.base if base is None else base, offset=self.offset + known)

    def slice_box(self, slices: Sequence[slice]) -> View:
        """Return a rectangular part of the view. Each slice needs a start and a stop."""
        offset = self.offset + sum(s.start * k for s, k in zip(slices, self.strides, strict=True))
        shape = tuple(len(range(s.start, s.stop, s.step or 1)) for s in slices)
        strides = tuple(k * (s.step or 1) for s, k in zip(slices, self.strides, strict=True))
        return replace(self, offset=offset, strides=strides, shape=shape)

    def reshape_view(self, shape: Sequence[int]) -> View | None:
        """Return a view of the same entries with another shape; None if this needs a copy."""
        shape = tuple(shape)
        if 0 in shape:
            return replace(self, strides=(0,) * len(shape), shape=shape)
        kept = [(n, s) for n, s in zip(self.shape, self.strides, strict=True) if n != 1]
        groups: list[tuple[int, int]] = []  # merged axes: (entries, stride)
        for n, s in kept:
            if groups and groups[-1][1] == n * s:
                groups[-1] = (groups[-1][0] * n, s)
            else:
                groups.append((n, s))
        strides: list[int] = []
        left = list(groups)
        for n in reversed(shape):
            if n == 1 or not left:
                strides.append(0)
                continue
            count, stride = left.pop()
            if count % n:
                return None
            strides.append(stride)
            if count > n:
                left.append((count // n, stride * n))
        if any(count != 1 for count, _ in left):
            return None
        return replace(self, strides=tuple(reversed(strides)), shape=shape)

    def transposed(self, permutation: Sequence[int]) -> View:
        return replace(
            self,
            strides=tuple(self.strides[k] for k in permutation),
            shape=tuple(self.shape[k] for k in permutation),
        )

    def broadcast(self, shape: Sequence[int], axes: Sequence[int]) -> View:
        """Broadcast like `jax.lax.broadcast_in_dim`. Axis k of the view becomes axis axes[k] of the
        result."""
        strides = [0] * len(shape)
        for k, axis in enumerate(axes):
            strides[axis] = self.strides[k] if self.shape[k] == shape[axis] else 0
        return replace(self, strides=tuple(strides), shape=tuple(shape))


#: an array in any of its forms (see the module's docstring)
ThreadArray = np.ndarray | View | Delayed

#: arrays of at most this size stay in registers if a team runs the program, as equal copies in each
#: thread
FEW = 16
#: least work, in operations, that the threads of a team divide among themselves
SHARED_ABOVE = 64


def is_constant(x: ThreadArray) -> bool:
    """Return whether all entries are constants."""
    return isinstance(x, np.ndarray) and x.dtype != object


def as_objects(x: np.ndarray) -> np.ndarray:
    """Convert an array of constants to an object array of `Value`s."""
    if x.dtype == object:
        return x
    out = np.empty(x.shape, object)
    flat = out.reshape(-1) if x.ndim else out
    for i, value in enumerate(x.reshape(-1)):
        flat[i if x.ndim else ()] = value
    return out


def indices_of(shape: Sequence[int]) -> Iterator[tuple[int, ...]]:
    """Iterate over the indices of all entries of a shape, in row-major order."""
    return iter(np.ndindex(tuple(shape)))


def full_of(shape: Sequence[int], value: Value) -> np.ndarray:
    """Return an object array filled with one value (`np.full` would convert the value)."""
    out = np.empty(shape, object)
    out[...] = value
    return out


def to_scalars(b: Builder, x: ThreadArray) -> np.ndarray:
    """Return the entries as an object array of `Value`s. Entries in memory are loaded."""
    if isinstance(x, Delayed):
        if not b.in_team or x.work <= SHARED_ABOVE or x.size == 1:
            out = np.empty(x.shape, object)
            for i in indices_of(x.shape):
                out[i] = x.entry(*map(I32.type, i))
            return out
        x = materialize_in_memory(b, x)
    if not isinstance(x, View):
        return as_objects(x)
    out = np.empty(x.shape, object)
    places = x.offsets()
    for i in indices_of(x.shape):
        out[i] = b.load(x.array, x.base, int(places[i]))
    return out


def fold_if_constant(x: np.ndarray, dtype: DTypeLike) -> np.ndarray:
    """Convert an object array to a numeric array if all its entries are constants."""
    if x.dtype != object:
        return x
    if not x.shape:
        value: Any = x[()]
        return np.asarray(value, dtype) if isinstance(value, np.generic) else x
    if all(isinstance(v, np.generic) for v in x.flat):
        return np.array([v for v in x.flat], dtype).reshape(x.shape)
    return x


def to_memory(b: Builder, x: ThreadArray, dtype: DTypeLike, keep: bool = False) -> View:
    """Return a view of x in memory: a table of constants, or a local copy of registers.

    keep: whether the memory is never changed, so that equal arrays are stored once.
    """
    if isinstance(x, View):
        return x
    if isinstance(x, Delayed):
        return materialize_in_memory(b, x)
    x = fold_if_constant(x, dtype)
    if is_constant(x):
        return View.of(b.table(np.ascontiguousarray(x)), x.shape)
    if keep or b.in_team:
        return _keep_in_memory(b, x, dtype)
    view = View.of(b.local(dtype, x.size), x.shape)
    write_to(b, view, x)
    return view


def _keep_in_memory(b: Builder, x: np.ndarray, dtype: DTypeLike) -> View:
    """Store values in memory, at a place that is never changed afterwards.

    Equal arrays are stored once. Axes along which values repeat are stored once, by a stride of 0.
    """
    repeats = [n > 1 and s == 0 for n, s in zip(x.shape, x.strides, strict=True)]
    own = x[tuple(slice(0, 1) if r else slice(None) for r in repeats)]

    def make() -> View:
        view = View.of(b.local(dtype, own.size), own.shape)
        write_to(b, view, own)
        view.array.reference_count += 1
        return view

    values = tuple(v.id if isinstance(v, Var) else (v.dtype.char, v.tobytes()) for v in own.flat)
    return b.memoize(("kept", own.shape, values), make).broadcast(x.shape, range(x.ndim))


def materialize_in_memory(b: Builder, x: Delayed) -> View:
    """Compute the entries of a delayed array, once, in memory that is never changed."""

    def make() -> tuple[View, Delayed]:
        view = View.of(b.local(x.dtype, max(x.size, 1)), x.shape)
        write_to(b, view, x)
        view.array.reference_count += 1
        return view, x  # x must live as long as id(x) is a key

    return b.memoize(("stored", id(x)), make)[0]


def materialize(b: Builder, x: ThreadArray) -> ThreadArray:
    """Compute a delayed array, in registers if it is small. Return other arrays unchanged."""
    if not isinstance(x, Delayed):
        return x
    few = (x.size <= FEW and x.work <= SHARED_ABOVE) or x.size == 1
    return to_scalars(b, x) if few else materialize_in_memory(b, x)


def write_to(b: Builder, to: View, x: ThreadArray, *, loop_above: int = 64) -> None:
    """Emit the copy of x to memory, by a loop if there are more than `loop_above` entries."""
    if isinstance(x, View) and x.is_same_view(to):
        return
    if b.in_team and isinstance(x, View):
        to, x = as_flat_views(to, x)
    if isinstance(x, Delayed) or (b.in_team and isinstance(x, View) and x.size > 1):
        for_each_index(b, to.shape, lambda *i: store_entry(b, to, i, load_entry(b, x, i)))
        return
    if b.in_team and is_constant(x) and x.size > FEW:
        loop_above = 0
    if x.size > loop_above and (isinstance(x, View) or is_constant(x)):
        value = x.flat[0] if isinstance(x, np.ndarray) and (x == x.flat[0]).all() else None
        moving = [to] if value is not None else [to, to_memory(b, x, to.dtype)]
        to, *source = moving if b.in_team else as_flat_views(*moving)

        def entry(*i: Value) -> Value:  # equal constants need no table
            return load_entry(b, source[0], i) if source else to.dtype.type(value)

        for_each_index(b, to.shape, lambda *i: store_entry(b, to, i, entry(*i)))
        return
    values, places = to_scalars(b, x), to.offsets()
    for i in indices_of(to.shape):
        b.store(to.array, to.base, int(places[i]), values[i])


def transposed(x: ThreadArray, order: Sequence[int]) -> ThreadArray:
    """Return x with its axes permuted, like `numpy.transpose`."""
    return x.transpose(order) if isinstance(x, np.ndarray) else x.transposed(order)


def as_flat_views(*views: View) -> Sequence[View]:
    """Flatten the views if the entries of each are equally spaced; else return them unchanged."""
    flat = [x.reshape_view((x.size,)) for x in views]
    return [x for x in flat if x is not None] if None not in flat else views


def copy_to_memory(b: Builder, x: ThreadArray, dtype: DTypeLike) -> View:
    """Return a local copy in memory, which may be changed."""
    view = View.of(b.local(dtype, x.size), x.shape)
    write_to(b, view, x)
    return view


def broadcast_in_memory(
    b: Builder, x: ThreadArray, dtype: DTypeLike, shape: tuple[int, ...]
) -> View | Delayed:
    """Put x in memory and broadcast it to a shape by numpy's rules. Delayed arrays stay delayed."""
    view = x if isinstance(x, Delayed) else to_memory(b, x, dtype)
    return view.broadcast(shape, range(len(shape) - view.ndim, len(shape)))


def load_entry(b: Builder, view: View | Delayed, index: Sequence[Value]) -> Value:
    """Emit the load (or the computation, if delayed) of one entry, and return its value."""
    if isinstance(view, Delayed):
        return view.entry(*index)
    there = view.shift(b, *zip(index, view.strides, strict=True))
    return b.load(there.array, there.base, there.offset)


def store_entry(b: Builder, view: View, index: Sequence[Value], value: Value) -> None:
    """Emit the store of one entry."""
    there = view.shift(b, *zip(index, view.strides, strict=True))
    b.store(there.array, there.base, there.offset, value)


def for_each_index(b: Builder, shape: Sequence[int], f: Callable[..., None], *index: Value) -> None:
    """Emit f(*index) for every index of a shape.

    The code is nested loops, or one loop whose iterations a team shares. Iterations must be
    independent.
    """
    if b.in_team and not math.prod(shape):
        return
    if b.in_team and math.prod(shape) != 1:
        with b.team_loop(math.prod(shape)) as counter:
            f(*index, *unravel_index(b, counter, shape))
    elif not shape:
        f(*index)
    elif shape[0] == 1:
        for_each_index(b, shape[1:], f, *index, I32.type(0))
    else:
        with b.loop(shape[0]) as counter:
            for_each_index(b, shape[1:], f, *index, counter)


def unravel_index(b: Builder, counter: Value, shape: Sequence[int]) -> list[Value]:
    """Emit the conversion of a row-major position to the index along each axis of a shape."""
    out: list[Value] = []
    wide = [n for n in shape if n > 1]
    for n in reversed(shape):
        if n == 1:
            out.append(I32.type(0))
            continue
        wide.pop()
        out.append(b.op("index_mod", I32, counter, I32.type(n)) if wide else counter)
        counter = b.op("index_div", I32, counter, I32.type(n)) if wide else counter
    return out[::-1]
