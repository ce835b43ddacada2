"""The rule of `rbjax.lanes.inverse`: Gauss and Jordan's elimination in place, with pivots.

Step k makes column k of the matrix that of the inverse: with the pivot p = a_kk,
    a_kj <- a_kj / p,    a_ij <- a_ij - a_ik a_kj,    column k: -a_ik / p and 1 / p
Rows that are exchanged for larger pivots are columns of the inverse, put back at the end.
(Golub & Van Loan, *Matrix Computations*, 3.4; a complex number is a tuple of two.)
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rbjax.threads.arrays import View, get, put
from rbjax.threads.indexing import changeable
from rbjax.threads.lowering import Lowering, Unsupported, rule
from rbjax.threads.program import BOOL, I32, Builder, Value

Number = tuple[Value, ...]  # real, or real and imaginary parts


@rule("inverse")
def _inverse(low: Lowering, eqn: Any, ins: list) -> list:
    shape, dtype = eqn.invars[0].aval.shape, eqn.invars[0].aval.dtype
    if len(shape) > 2:
        raise Unsupported("inverse of a stack of matrices")
    parts = []
    for x in ins:  # each part has memory of its own
        part = changeable(low, x, dtype)
        part.array.owners += 1
        parts.append(part)
    _Elimination(low.b, parts, shape[0]).run()
    for part in parts:
        part.array.owners -= 1
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
            put(b, self._rows, (k,), p)
            with b.loop(n) as j:
                self._exchange(k, j, p, j)
            scale = self._reciprocal(self._get(k, k))
            one = self._dtype.type(1), self._dtype.type(0)
            self._put(k, k, one[: len(self._parts)])
            with b.loop(n) as j:
                self._put(k, j, self._product(self._get(k, j), scale))
            with b.loop(n) as i, b.when(b.op("ne", BOOL, i, k)):
                factor = self._get(i, k)
                self._put(i, k, (self._dtype.type(0),) * len(self._parts))
                with b.loop(n) as j:
                    taken = self._product(factor, self._get(k, j))
                    self._put(i, j, self._each("sub", self._get(i, j), taken))
        with b.loop(n, reverse=True) as k:
            p = get(b, self._rows, (k,))
            with b.loop(n) as i:
                self._exchange(i, k, i, p)

    def _pivot(self, k: Value) -> Value:
        """The row, from k on, of the largest entry of column k."""
        b = self._b
        best, at = b.declare(self._dtype, self._dtype.type(-1)), b.declare(I32, k)
        with b.loop(self._n) as i:
            squares = [b.op("mul", self._dtype, x, x) for x in self._get(i, k)]
            size = squares[0]
            for x in squares[1:]:
                size = b.op("add", self._dtype, size, x)
            below, larger = b.op("ge", BOOL, i, k), b.op("gt", BOOL, size, best)
            with b.when(b.op("and", BOOL, below, larger)):
                b.assign(best, size)
                b.assign(at, i)
        return at

    def _exchange(self, i: Value, j: Value, k: Value, l: Value) -> None:
        a, c = self._get(i, j), self._get(k, l)
        self._put(i, j, c)
        self._put(k, l, a)

    def _get(self, i: Value, j: Value) -> Number:
        return tuple(get(self._b, x, (i, j)) for x in self._parts)

    def _put(self, i: Value, j: Value, number: Number) -> None:
        for x, value in zip(self._parts, number, strict=True):
            put(self._b, x, (i, j), value)

    def _each(self, name: str, x: Number, y: Number) -> Number:
        op = self._b.op
        return tuple(op(name, self._dtype, a, c) for a, c in zip(x, y, strict=True))

    def _product(self, x: Number, y: Number) -> Number:
        def op(name: str, a: Value, c: Value) -> Value:
            return self._b.op(name, self._dtype, a, c)

        if len(x) == 1:
            return (op("mul", x[0], y[0]),)
        (a, b), (c, d) = x, y
        real = op("sub", op("mul", a, c), op("mul", b, d))
        return real, op("add", op("mul", a, d), op("mul", b, c))

    def _reciprocal(self, x: Number) -> Number:
        def op(name: str, *args: Value) -> Value:
            return self._b.op(name, self._dtype, *args)

        one = self._dtype.type(np.float64(1))
        if len(x) == 1:
            return (op("div", one, x[0]),)
        a, b = x
        size = op("div", one, op("add", op("mul", a, a), op("mul", b, b)))
        return op("mul", a, size), op("neg", op("mul", b, size))
