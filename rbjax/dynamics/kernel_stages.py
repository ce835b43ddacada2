"""The stages of an explicit Runge-Kutta method inside a kernel.

    k_i = f(h sum_j a_ij k_j),    increment h sum_j b_j k_j,    f(u, w) = (u', a)

Very few links: the stages are written out, and all k stay in registers. Others: a loop over the
stages, with the k in rows of the memory; for each stage a table says which of them it mixes and
how much of each, since most coefficients of a method of high order are zero, and reading the k is
what costs.
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
    """For each row of a, then b: how many are not zero; pairs (j, a_ij) of these, and of zeros up
    to the longest row."""
    if table is None:
        return jnp.zeros(1, dtype)
    a = np.vstack([table.a, table.b])
    out = np.zeros((len(a), 1 + 2 * longest(table)))
    for row, weights in zip(out, a, strict=True):
        used = np.flatnonzero(weights)
        row[0] = len(used)
        row[1 : 1 + 2 * len(used) : 2], row[2 : 2 + 2 * len(used) : 2] = used, weights[used]
    return jnp.asarray(out.reshape(-1), dtype)


def longest(table: Any) -> int:
    """The most stages that are mixed at once."""
    return int((np.vstack([table.a, table.b]) != 0).sum(1).max())


class Scheme:
    """A tableau in a block: `ref` holds its coefficients; u' and a of a stage are 2 nv rows."""

    def __init__(self, table: Any, ref: Any, memory: Memory, nv: int, registers: bool):
        self.table, self.ref, self.memory, self.nv = table, ref, memory, nv
        self.stages, self.most = table.stages, longest(table)
        self.written = registers and nv <= WRITTEN_UP_TO
        self.row = memory.take(2 * nv * self.stages)

        def clear(i, _):  # what meets a weight of zero must be a number
            memory.write(self.row + i, 0.0)
            return 0

        loop(clear, 0, 0, 2 * nv)

    def keep(self, k: Any, i: Any, x: Any) -> None:
        """Number i of stage k: the coordinates of u', then those of a."""
        self.memory.write(self.row + 2 * self.nv * k + i, x)

    def _mixed(self, k: Any, n: Any) -> tuple[Any, Any]:
        """The first row of the n-th stage that stage k mixes, and its weight."""
        at = k * (1 + 2 * self.most) + 1 + 2 * n
        return self.row + 2 * self.nv * self.ref[at].astype(jnp.int32), self.ref[at + 1]

    def sums(self, k: Any, i: Any, h: Any) -> tuple[jax.Array, jax.Array]:
        """h sum_j a_kj k_j of coordinate i, of both halves; k = stages for b. Reads that do not
        wait for each other: those of weight zero cost less than a loop."""
        pairs = [self._mixed(k, n) for n in range(self.most)]
        u, w = (
            h * sum(weight * self.memory.read(row + half * self.nv + i) for row, weight in pairs)
            for half in range(2)
        )
        return u, w

    def increments(self, rate: Callable, h: Any, like: jax.Array) -> tuple[list, list]:
        """(u, w) of a step on lists of lanes; rate(u, w) gives their rates."""
        n, none = self.nv, jnp.zeros_like(like)
        if not self.written:

            def all_sums(k: Any) -> tuple[list, list]:
                def more(p, sums):
                    row, weight = self._mixed(k, p)
                    return [x + weight * self.memory.read(row + i) for i, x in enumerate(sums)]

                count = self.ref[k * (1 + 2 * self.most)].astype(jnp.int32)
                out = [h * x for x in jax.lax.fori_loop(0, count, more, [none] * (2 * n))]
                return out[:n], out[n:]

            def stage(k, _):
                u, w = rate(*all_sums(k))
                for i, x in enumerate(as_arrays([*u, *w], like)):
                    self.keep(k, i, x)
                return 0

            loop(stage, 0, 0, self.stages)
            return all_sums(self.stages)
        ks: list = []

        def mixed(row):
            used = [(w, k) for w, k in zip(row, ks, strict=False) if w]
            return [[h * sum((w * k[half][i] for w, k in used), none) for i in range(n)]
                    for half in range(2)]  # fmt: skip

        for row in self.table.a:
            ks.append(as_arrays(rate(*mixed(row)), like))
        u, w = mixed(self.table.b)
        return u, w
