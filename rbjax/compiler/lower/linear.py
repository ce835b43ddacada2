"""Lowering rules for matrix products and matrix inverses."""

from __future__ import annotations

import functools
import math
import operator
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import DTypeLike

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.elementary import Number
from rbjax.compiler.ir.statements import BOOL, I32, Unsupported, Value
from rbjax.compiler.lower import arrays
from rbjax.compiler.lower.arrays import ThreadArray, View
from rbjax.compiler.lower.delayed import Delayed
from rbjax.compiler.lower.elementwise import source
from rbjax.compiler.lower.indexing import make_updatable
from rbjax.compiler.lower.lowering import Equation, Lowering, accepts_delayed, dtype_of, rule

#: products of more terms are computed by loops
UNROLL_UP_TO = 512
#: the same limit for two matrices on a GPU, where a loop waits for two loads at each term
MATRICES_UP_TO = 2048
#: the same limit if a matrix row fills the vectors of a CPU, so that a loop over rows is fast
VECTORS_UP_TO = 100
#: the most terms of a sum that one thread of a team computes without a loop
TERMS_UP_TO = 32
#: sums that a loop on a CPU computes together; with their operands they fit into 16 registers
SIDE_BY_SIDE = 12


@rule("dot_general")
def _dot(low: Lowering, eqn: Equation, ins: list) -> list:
    ((ca, cb), (ba, bb)), dtype = eqn.params["dimension_numbers"], dtype_of(eqn.outvars[0].aval)
    fa = [k for k in range(len(ins[0].shape)) if k not in (*ca, *ba)]
    fb = [k for k in range(len(ins[1].shape)) if k not in (*cb, *bb)]
    x = arrays.transposed(ins[0], (*ba, *fa, *ca))
    y = arrays.transposed(ins[1], (*bb, *fb, *cb))
    nb, na, ny = len(ba), len(fa), len(fb)
    shape = (*x.shape[:nb], *x.shape[nb : nb + na], *y.shape[nb : nb + ny])
    contracted = x.shape[nb + na :]
    terms = math.prod(contracted)
    if low.b.in_team and 2 * math.prod(shape) * terms > arrays.SHARED_ABOVE:
        return [_delayed(low, x, y, shape, contracted, (nb, na, ny), dtype)]
    if math.prod(shape) * terms > _unrolled(low.b, bool(fa and fb)):
        return [_looped(low, x, y, shape, contracted, (nb, na, ny), dtype)]
    a, c = low.to_scalars(x), low.to_scalars(y)
    b, out = low.b, np.empty(shape, object)
    for i in arrays.indices_of(shape):
        left, right = (*i[: nb + na],), (*i[:nb], *i[nb + na :])
        total: Value = dtype.type(0)
        for t in arrays.indices_of(contracted):
            term = b.op("mul", dtype, b.cast(a[left + t], dtype), b.cast(c[right + t], dtype))
            total = b.op("add", dtype, total, term)
        out[i] = total
    return [out]


accepts_delayed("dot_general")


def _unrolled(b: Builder, matrices: bool) -> int:
    """Return the largest number of terms of a product that is unrolled. matrices: both factors are
    matrices."""
    if b.matrices:
        return VECTORS_UP_TO
    return MATRICES_UP_TO if matrices and b.platform == "cuda" else UNROLL_UP_TO


def _delayed(
    low: Lowering, x: ThreadArray, y: ThreadArray, shape: tuple, contracted: tuple, sizes: tuple,
    dtype: DTypeLike,
) -> ThreadArray:  # fmt: skip
    """Return a product as a delayed array, whose sums are computed when they are read.
    A factor that several sums read and that is expensive is put in memory first."""
    b, (nb, na, ny) = low.b, sizes
    terms = math.prod(contracted)
    if not terms:
        return np.zeros(shape, dtype)
    ways = math.prod(y.shape[nb : nb + ny]), math.prod(x.shape[nb : nb + na])
    x, y = (
        arrays.to_memory(b, z, dtype) if n > 1 and isinstance(z, Delayed) and z.cost > 2 else z
        for z, n in zip((x, y), ways, strict=True)
    )
    s, t = source(b, x, x.shape), source(b, y, y.shape)

    def entry(*i: Value) -> Value:
        left, right = i[: nb + na], (*i[:nb], *i[nb + na :])

        def term(*k: Value) -> Value:
            pair = (b.cast(z.entry(*at, *k), dtype) for z, at in ((s, left), (t, right)))
            return b.op("mul", dtype, *pair)

        return sum_terms(b, contracted, term, functools.partial(b.op, "add", dtype), dtype)

    cost = terms * (2 + s.cost + t.cost)
    return Delayed(shape, np.dtype(dtype), entry, s.sources | t.sources, cost)


def sum_terms(b: Builder, shape: tuple, term: Callable, add: Callable, dtype: DTypeLike) -> Value:
    """Emit the reduction of term(*index), over all indices of a nonempty shape, by `add`."""
    if math.prod(shape) <= TERMS_UP_TO:
        every = [term(*map(I32.type, k)) for k in arrays.indices_of(shape)]
        return functools.reduce(add, every)
    first = term(*(I32.type(0) for _ in shape))
    total = b.declare(dtype, first)
    started = b.declare(BOOL, np.bool_(False))

    def more(*k: Value) -> None:
        value = term(*k)
        b.assign(total, b.select(started, add(total, value), value))
        b.assign(started, np.bool_(True))

    with b.per_thread():
        arrays.for_each_index(b, shape, more)
    return total


def _looped(
    low: Lowering, x: ThreadArray, y: ThreadArray, shape: tuple, contracted: tuple, sizes: tuple,
    dtype: DTypeLike,
) -> View:  # fmt: skip
    """Emit a product as loops. On a CPU, several sums are computed together and share loads."""
    b, (nb, na, ny) = low.b, sizes
    x, y = arrays.to_memory(b, x, dtype), arrays.to_memory(b, y, dtype)
    if b.matrices and na and ny and y.strides[nb + ny - 1] != 1:
        y = _side_by_side(b, y, nb, ny)
    out = View.of(b.local(dtype, math.prod(shape)), shape)
    if ny:
        inner = out
    elif na:
        x, y, na, inner = y, x, 0, out
    else:  # only batch axes: one sum per index
        y, inner = (_with_axis(v, nb) for v in (y, out))
    count, width = inner.shape[-1], SIDE_BY_SIDE if b.platform == "cpu" else 1
    whole = count - count % width
    for start, stop, size in ((0, whole, width), (whole, count, count - whole)):
        if stop > start:
            rows = _in_tiles(y, y.ndim - len(contracted) - 1, start, stop, size)
            _sums(b, x, rows, _in_tiles(inner, inner.ndim - 1, start, stop, size), (nb, na))
    return out


def _side_by_side(b: Builder, y: View, nb: int, ny: int) -> View:
    """Copy y so that its free axes are last in memory, and a row of sums reads contiguous entries.
    nb: number of batch axes of y. ny: number of its free axes, which follow."""
    order = (*range(nb), *range(nb + ny, y.ndim), *range(nb, nb + ny))
    rows = arrays.transposed(y, order)
    assert isinstance(rows, View)
    copy = View.of(b.local(y.dtype, y.size), rows.shape)
    arrays.write_to(b, copy, rows)
    back = arrays.transposed(copy, tuple(np.argsort(order)))
    assert isinstance(back, View)
    return back


def _sums(b: Builder, x: View, y: View, out: View, sizes: tuple[int, int]) -> None:
    """Emit out = sum of x * y over the last axes.
    The last axis of out is a tile, whose sums are computed together. y has the same axis."""
    (nb, na), dtype = sizes, out.dtype
    tile = [np.int32(k) for k in range(out.shape[-1])]

    def one(*i: Value) -> None:
        left, right = i[: nb + na], (*i[:nb], *i[nb + na :])
        totals = [b.declare(dtype, dtype.type(0)) for _ in tile]

        def more(*t: Value) -> None:
            for k, total in zip(tile, totals, strict=True):
                first = arrays.load_entry(b, x, (*left, *t))
                second = arrays.load_entry(b, y, (*right, k, *t))
                b.assign(total, b.op("add", dtype, total, b.op("mul", dtype, first, second)))

        arrays.for_each_index(b, x.shape[nb + na :], more)
        for k, total in zip(tile, totals, strict=True):
            arrays.store_entry(b, out, (*i, k), total)

    arrays.for_each_index(b, out.shape[:-1], one)


def _in_tiles(x: View, axis: int, start: int, stop: int, size: int) -> View:
    """Split entries start ... stop of an axis into two axes: tiles, and entries of a tile."""
    step = x.strides[axis]
    return replace(
        x, offset=x.offset + start * step,
        strides=(*x.strides[:axis], size * step, step, *x.strides[axis + 1 :]),
        shape=(*x.shape[:axis], (stop - start) // size, size, *x.shape[axis + 1 :]),
    )  # fmt: skip


def _with_axis(x: View, axis: int) -> View:
    """Insert an axis of one entry."""
    strides, shape = ((*xs[:axis], n, *xs[axis:]) for xs, n in ((x.strides, 0), (x.shape, 1)))
    return replace(x, strides=strides, shape=shape)


Entry = tuple[Number, ...]  # (real,) or (real, imaginary)


@rule("inverse")
def _inverse(low: Lowering, eqn: Equation, ins: list) -> list:
    shape, dtype = eqn.invars[0].aval.shape, eqn.invars[0].aval.dtype
    if len(shape) > 2:
        raise Unsupported("inverse of a stack of matrices")
    parts = []
    for x in ins:  # each part needs its own memory
        part = make_updatable(low, x, dtype)
        part.array.reference_count += 1
        parts.append(part)
    _Elimination(low.b, parts, shape[0]).run()
    for part in parts:
        part.array.reference_count -= 1
    return parts


class _Elimination:
    """In-place Gauss-Jordan elimination of a matrix (n, n) with row pivoting.

    A real matrix is one view; a complex matrix is two, its real and imaginary parts. With the pivot
    p = a_kk, step k is

    a_kj <- a_kj / p,  a_ij <- a_ij - a_ik a_kj,  column k: -a_ik / p and 1 / p.

    A row exchange permutes columns of the inverse, which is undone at the end.
    (Golub & Van Loan, *Matrix Computations*, 3.4)
    """

    def __init__(self, b: Builder, parts: Sequence[View], n: int):
        self._b, self._parts, self._n = b, parts, n
        self._dtype = parts[0].dtype
        self._rows = View.of(b.local(I32, n), (n,))

    def run(self) -> None:
        b, n = self._b, self._n
        with b.loop(n) as k:
            p = self._pivot(k)
            arrays.store_entry(b, self._rows, (k,), p)
            with b.loop(n) as j:
                self._exchange(k, j, p, j)
            scale = _reciprocal(self._get(k, k))
            self._put(k, k, (self._known(1), self._known(0))[: len(self._parts)])
            with b.loop(n) as j:
                self._put(k, j, _product(self._get(k, j), scale))
            with b.loop(n) as i, b.when(b.op("ne", BOOL, i, k)):
                factor = self._get(i, k)
                self._put(i, k, (self._known(0),) * len(self._parts))
                with b.loop(n) as j:
                    taken = _product(factor, self._get(k, j))
                    self._put(i, j, _difference(self._get(i, j), taken))
        with b.loop(n, reverse=True) as k:
            p = arrays.load_entry(b, self._rows, (k,))
            with b.loop(n) as i:
                self._exchange(i, k, i, p)

    def _pivot(self, k: Value) -> Value:
        """Emit the search for the row >= k with the largest entry in column k."""
        b = self._b
        best, at = b.declare(self._dtype, self._dtype.type(-1)), b.declare(I32, k)
        with b.loop(self._n) as i:
            size = functools.reduce(operator.add, [x * x for x in self._get(i, k)])
            better = (Number(b, i) >= Number(b, k)) & (size > Number(b, best))
            with b.when(better.value):
                b.assign(best, size.value)
                b.assign(at, i)
        return at

    def _exchange(self, i: Value, j: Value, k: Value, l: Value) -> None:
        a, c = self._get(i, j), self._get(k, l)
        self._put(i, j, c)
        self._put(k, l, a)

    def _known(self, x: float) -> Number:
        return Number(self._b, self._dtype.type(x))

    def _get(self, i: Value, j: Value) -> Entry:
        return tuple(Number(self._b, arrays.load_entry(self._b, x, (i, j))) for x in self._parts)

    def _put(self, i: Value, j: Value, entry: Entry) -> None:
        for x, number in zip(self._parts, entry, strict=True):
            arrays.store_entry(self._b, x, (i, j), number.value)


def _difference(x: Entry, y: Entry) -> Entry:
    return tuple(a - b for a, b in zip(x, y, strict=True))


def _product(x: Entry, y: Entry) -> Entry:
    if len(x) == 1:
        return (x[0] * y[0],)
    (a, b), (c, d) = x, y
    return a * c - b * d, a * d + b * c


def _reciprocal(x: Entry) -> Entry:
    if len(x) == 1:
        return (1 / x[0],)
    a, b = x
    scale = 1 / (a * a + b * b)
    return a * scale, -(b * scale)
