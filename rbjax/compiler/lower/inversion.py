"""The rule of `rbjax.lanes.primitives`: Gauss and Jordan's elimination in place, with pivots.

Step k makes column k of the matrix that of the inverse: with the pivot p = a_kk,
    a_kj <- a_kj / p,    a_ij <- a_ij - a_ik a_kj,    column k: -a_ik / p and 1 / p
Rows that are exchanged for larger pivots are columns of the inverse, put back at the end.
(Golub & Van Loan, *Matrix Computations*, 3.4; a complex number is a tuple of two.)
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence

from rbjax.compiler.ir.builder import Builder
from rbjax.compiler.ir.expressions import Number
from rbjax.compiler.ir.statements import BOOL, I32, Unsupported, Value
from rbjax.compiler.lower.arrays import View, load_entry, store_entry
from rbjax.compiler.lower.indexing import changeable
from rbjax.compiler.lower.lowering import Equation, Lowering, rule

Entry = tuple[Number, ...]  # real, or real and imaginary parts


@rule("inverse")
def _inverse(low: Lowering, eqn: Equation, ins: list) -> list:
    shape, dtype = eqn.invars[0].aval.shape, eqn.invars[0].aval.dtype
    if len(shape) > 2:
        raise Unsupported("inverse of a stack of matrices")
    parts = []
    for x in ins:  # each part has memory of its own
        part = changeable(low, x, dtype)
        part.array.reference_count += 1
        parts.append(part)
    _Elimination(low.b, parts, shape[0]).run()
    for part in parts:
        part.array.reference_count -= 1
    return parts


class _Elimination:
    """In place, on views of the parts of a matrix (n, n)."""

    def __init__(self, b: Builder, parts: Sequence[View], n: int):
        self._b, self._parts, self._n = b, parts, n
        self._dtype = parts[0].dtype
        self._rows = View.of(b.local(I32, n), (n,))

    def run(self) -> None:
        b, n = self._b, self._n
        with b.loop(n) as k:
            p = self._pivot(k)
            store_entry(b, self._rows, (k,), p)
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
            p = load_entry(b, self._rows, (k,))
            with b.loop(n) as i:
                self._exchange(i, k, i, p)

    def _pivot(self, k: Value) -> Value:
        """The row, from k on, of the largest entry of column k."""
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
        return tuple(Number(self._b, load_entry(self._b, x, (i, j))) for x in self._parts)

    def _put(self, i: Value, j: Value, entry: Entry) -> None:
        for x, number in zip(self._parts, entry, strict=True):
            store_entry(self._b, x, (i, j), number.value)


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
