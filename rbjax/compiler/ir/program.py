"""The program of one sample of a batch, and the layout of samples in memory.

A batch has one or several axes, at any positions in an operand. Each thread offsets its pointers to
its sample, so no operand is copied.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.statements import Array, Op, Reserve, While, walk


def row_major(shape: Sequence[int]) -> tuple[int, ...]:
    """Return the strides, in entries, of a row-major array."""
    return tuple(math.prod(shape[k + 1 :]) for k in range(len(shape)))


@dataclass(frozen=True)
class BatchLayout:
    """The layout of the samples of a batch in an array.

    shape: shape of the array in memory.
    axes: position in `shape` of each axis of the batch; None if all samples share the array.
    """

    shape: tuple[int, ...]
    axes: tuple[int | None, ...]

    @property
    def sample(self) -> tuple[int, ...]:
        """The shape of one sample."""
        return tuple(n for k, n in enumerate(self.shape) if k not in self.axes)

    @property
    def strides(self) -> tuple[int, ...]:
        """The strides between entries of a sample, in entries."""
        every = row_major(self.shape)
        return tuple(s for k, s in enumerate(every) if k not in self.axes)

    @property
    def steps(self) -> tuple[int, ...]:
        """The strides between samples along each axis of the batch, in entries; 0 if shared."""
        every = row_major(self.shape)
        return tuple(0 if axis is None else every[axis] for axis in self.axes)

    def rows(self, batch: tuple[int, ...]) -> int | None:
        """Return the entries of a sample if samples are consecutive rows in memory; else None."""
        if not self.axes or None in self.axes:
            return None
        n = math.prod(self.sample)
        steps, size = [], n
        for count in reversed(batch):
            steps.append(size)
            size *= count
        wanted = tuple(reversed(steps))
        alike = all(a == b or c == 1 for a, b, c in zip(self.steps, wanted, batch, strict=True))
        return n if alike and self.strides == row_major(self.sample) else None


def batch_first(sample: Sequence[int], batch: Sequence[int]) -> BatchLayout:
    """Return the layout of an array whose batch axes come before its own axes."""
    return BatchLayout((*batch, *sample), tuple(range(len(batch))))


def batch_last(sample: Sequence[int], batch: Sequence[int]) -> BatchLayout:
    """Return the layout of an array whose batch axes come after its own axes."""
    n = len(sample)
    return BatchLayout((*sample, *batch), tuple(range(n, n + len(batch))))


@dataclass(frozen=True)
class Written:
    """A lowered program with its operands, results and batch.

    builder: contains the statements (`builder.block`) and tables.
    layouts: layouts of the operands and of the results.
    summed: for each result, whether it is the sum over the batch.
    """

    builder: Builder
    operands: tuple[Array, ...]
    results: tuple[Array, ...]
    layouts: tuple[tuple[BatchLayout, ...], tuple[BatchLayout, ...]]
    batch: tuple[int, ...]
    summed: tuple[bool, ...]

    @property
    def statements(self) -> int:
        """The number of operations in the code of one thread. Operations of a loop count once."""
        return sum(isinstance(s, Op) for s in walk(self.builder.block))

    @property
    def iterates(self) -> bool:
        """Whether the program has a `while` loop."""
        return any(isinstance(s, While) for s in walk(self.builder.block))

    @property
    def array_bytes(self) -> int:
        """The size of the local arrays of one thread, in bytes."""
        arrays = [s.array for s in walk(self.builder.block) if isinstance(s, Reserve)]
        return sum(a.size * a.dtype.itemsize for a in arrays)
