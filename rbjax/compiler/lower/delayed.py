"""Delayed arrays: the entries are computed when they are read.

A team of threads computes a chain of elementwise operations in one fused loop, without temporary
arrays. A slice or a reshape only changes the index.

Source: pull arrays (Keller et al. 2010, *Regular, shape-polymorphic, parallel arrays in Haskell*).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.statements import I32, Array, Value


class Shaped:
    """A base class of arrays with a shape, for their number of axes and their size."""

    __slots__ = ()
    shape: tuple[int, ...]

    @property
    def ndim(self) -> int:
        return len(self.shape)

    @property
    def size(self) -> int:
        return math.prod(self.shape)


@dataclass(frozen=True, slots=True, eq=False)
class Delayed(Shaped):
    """An array that is given by a function which emits the computation of one entry.

    entry: maps an index, one `Value` per axis, to the value of the entry.
    sources: the arrays in memory that `entry` reads.
    cost: operations per entry.
    """

    shape: tuple[int, ...]
    dtype: np.dtype
    entry: Callable[..., Value]
    sources: frozenset[Array]
    cost: int

    @property
    def work(self) -> int:
        return self.size * self.cost

    def shift(self, shape: Sequence[int], index: Callable[..., Sequence[Value]]) -> Delayed:
        """Return an array of another shape whose entry i is the entry index(*i) of this array."""
        entry = self.entry
        return replace(self, shape=tuple(shape), entry=lambda *i: entry(*index(*i)))

    def transposed(self, permutation: Sequence[int]) -> Delayed:
        order = np.argsort(permutation)
        shape = [self.shape[k] for k in permutation]
        return self.shift(shape, lambda *i: [i[k] for k in order])

    def broadcast(self, shape: Sequence[int], axes: Sequence[int]) -> Delayed:
        """Broadcast like `jax.lax.broadcast_in_dim`."""
        wide = [self.shape[k] == shape[axis] for k, axis in enumerate(axes)]
        zero = I32.type(0)
        return self.shift(shape, lambda *i: [
            i[axis] if w else zero for axis, w in zip(axes, wide, strict=True)
        ])  # fmt: skip

    def slice_box(self, b: Builder, slices: Sequence[slice]) -> Delayed:
        """Return a rectangular part of the array."""
        shape = [len(range(s.start, s.stop, s.step or 1)) for s in slices]
        return self.shift(shape, lambda *i: [
            _along(b, k, s.start, s.step or 1) for k, s in zip(i, slices, strict=True)
        ])  # fmt: skip

    def reshape_view(self, shape: Sequence[int]) -> Delayed | None:
        """Add or remove axes of one entry. Return None for any other change of shape."""
        own, new = ([k for k, n in enumerate(s) if n != 1] for s in (self.shape, shape))
        if [self.shape[k] for k in own] != [shape[k] for k in new]:
            return None
        place = dict(zip(own, new, strict=True))
        zero = I32.type(0)
        return self.shift(
            shape, lambda *i: [i[place[k]] if k in place else zero for k in range(self.ndim)]
        )


def _along(b: Builder, k: Value, start: int, step: int) -> Value:
    """Emit the index start + k * step."""
    return b.op("index_add", I32, b.op("index_mul", I32, k, I32.type(step)), I32.type(start))
