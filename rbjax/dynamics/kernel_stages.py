"""The stages of an explicit Runge-Kutta method inside a kernel.

    k_i = f(h sum_j a_ij k_j),    increment h sum_j b_j k_j,    f(u, w) = (u', a)

Few links: the stages are written out, and all k stay in registers. More: a loop over the stages,
with the k in rows of the memory and the coefficients, b their last row, read by index; rows above
the diagonal are read, too (they meet zeros), since reads that do not wait for each other cost less
than a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.kernel_drivers import Memory, loop
from rbjax.lanes import as_arrays

#: up to this many velocity coordinates the stages are written out
WRITTEN_UP_TO = 2


def coefficients(table: Any, dtype: Any) -> jax.Array:
    """a and b of a tableau, row after row."""
    if table is None:
        return jnp.zeros(1, dtype)
    return jnp.asarray(np.vstack([table.a, table.b]).reshape(-1), dtype)


class Scheme:
    """A tableau in a block: `ref` holds its coefficients, `nv` rows are each half of a k."""

    def __init__(self, table: Any, ref: Any, memory: Memory, nv: int, registers: bool):
        self.table, self.ref, self.memory, self.nv = table, ref, memory, nv
        self.stages, self.written = table.stages, registers and nv <= WRITTEN_UP_TO
        self.row = memory.take(2 * nv * self.stages)
        if not self.written:
            loop(lambda i, _: (memory.write(self.row + i, 0.0), 0)[1], 0, 0, 2 * nv * self.stages)

    def keep(self, k: Any, half: int, i: Any, x: Any) -> None:
        """Coordinate i of stage k: of u' (half = 0) or a (1)."""
        self.memory.write(self.row + (2 * k + half) * self.nv + i, x)

    def sums(self, k: Any, i: Any, h: Any) -> tuple[jax.Array, jax.Array]:
        """h sum_j a_kj k_j of coordinate i, of both halves; k = stages for b."""
        weights = [self.ref[k * self.stages + j] for j in range(self.stages)]
        out = []
        for half in range(2):
            rows = [self.row + (2 * j + half) * self.nv + i for j in range(self.stages)]
            ks = [self.memory.read(row) for row in rows]
            out.append(h * sum(w * x for w, x in zip(weights, ks, strict=True)))
        return out[0], out[1]

    def increments(self, rate: Callable, h: Any, like: jax.Array) -> tuple[list, list]:
        """(u, w) of a step on lists of lanes; rate(u, w) gives their rates."""
        n = range(self.nv)
        if not self.written:

            def stage(k, _):
                u, w = zip(*(self.sums(k, i, h) for i in n), strict=True)
                for half, lanes in enumerate(rate(list(u), list(w))):
                    for i, x in enumerate(lanes):
                        self.keep(k, half, i, x)
                return 0

            loop(stage, 0, 0, self.stages)
            u, w = zip(*(self.sums(self.stages, i, h) for i in n), strict=True)
            return list(u), list(w)
        ks: list = []

        def mixed(row):
            used = [(w, k) for w, k in zip(row, ks, strict=False) if w]
            none = jnp.zeros_like(like)
            return [[h * sum((w * k[half][i] for w, k in used), none) for i in n]
                    for half in range(2)]  # fmt: skip

        for row in self.table.a:
            ks.append(as_arrays(rate(*mixed(row)), like))
        u, w = mixed(self.table.b)
        return u, w
