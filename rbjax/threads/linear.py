"""Rules for matrix products."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rbjax.threads.arrays import Small, View, each, get, in_memory, put
from rbjax.threads.lowering import Lowering, dtype_of, rule
from rbjax.threads.program import Value

#: products with more terms are loops
UNROLL_UP_TO = 512


@rule("dot_general")
def _dot(low: Lowering, eqn: Any, ins: list) -> list:
    ((ca, cb), (ba, bb)), dtype = eqn.params["dimension_numbers"], dtype_of(eqn.outvars[0].aval)
    fa = [k for k in range(len(ins[0].shape)) if k not in (*ca, *ba)]
    fb = [k for k in range(len(ins[1].shape)) if k not in (*cb, *bb)]
    x = _transposed(ins[0], (*ba, *fa, *ca))
    y = _transposed(ins[1], (*bb, *fb, *cb))
    nb, na, ny = len(ba), len(fa), len(fb)
    shape = (*x.shape[:nb], *x.shape[nb : nb + na], *y.shape[nb : nb + ny])
    contracted = x.shape[nb + na :]
    if math.prod(shape) * math.prod(contracted) > UNROLL_UP_TO:
        return [_looped(low, x, y, shape, contracted, (nb, na, ny), dtype)]
    a, c = low.scalars(x), low.scalars(y)
    b, out = low.b, np.empty(shape, object)
    for i in np.ndindex(shape):
        left, right = (*i[: nb + na],), (*i[:nb], *i[nb + na :])
        total: Value = dtype.type(0)
        for t in np.ndindex(contracted):
            term = b.op("mul", dtype, b.cast(a[left + t], dtype), b.cast(c[right + t], dtype))
            total = b.op("add", dtype, total, term)
        out[i] = total
    return [out]


def _transposed(x: Small, order: tuple) -> Small:
    return x.transposed(order) if isinstance(x, View) else x.transpose(order)


def _looped(
    low: Lowering, x: Small, y: Small, shape: tuple, contracted: tuple, sizes: tuple, dtype: Any
) -> View:
    b, (nb, na, _) = low.b, sizes
    x, y = in_memory(b, x, dtype), in_memory(b, y, dtype)
    out = View.of(b.local(dtype, math.prod(shape)), shape)

    def one(*i: Value) -> None:
        left, right = i[: nb + na], (*i[:nb], *i[nb + na :])
        total = b.declare(dtype, dtype.type(0))

        def more(*t: Value) -> None:
            term = b.op("mul", dtype, get(b, x, (*left, *t)), get(b, y, (*right, *t)))
            b.assign(total, b.op("add", dtype, total, term))

        each(b, contracted, more)
        put(b, out, i, total)

    each(b, shape, one)
    return out
