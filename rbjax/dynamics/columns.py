"""Matrices column by column, a GPU thread a column.

Matrices of n x n entries are too long a program for one thread of a humanoid, and hold too much of
a sample in one. So a first kernel, one thread a sample, leaves one row of numbers for each link; in
a second one each thread makes one column of all matrices, from the rows of all links (which the
threads of a sample read together) and its own link's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.aba import Factor, solve
from rbjax.dynamics.drivers import Driver
from rbjax.dynamics.packing import pack
from rbjax.dynamics.pairs import pair_column, which_moves
from rbjax.dynamics.unrolled import Unrolled
from rbjax.lanes import Mat3, Vec3
from rbjax.materialize import batch_first, batch_last
from rbjax.model import Model
from rbjax.spatial import Force, Motion, Transform
from rbjax.threads import side_by_side, threaded

#: design to be timed: rows of links are written with the batch last, and XLA turns them about
TURNED = False

UNMOVED = Transform(Mat3.identity(), Vec3.zero())


def lane_rows(d: Driver, values: Any, like: jax.Array) -> jax.Array:
    """Per-link values as an array (lanes, n)."""
    return jnp.stack(jax.tree.leaves(d.columns(values, like)))


def rows_of(d: Driver, values: Any, size: int, like: jax.Array) -> jax.Array:
    """Per-link rows (`row`) as an array (n, size)."""
    return d.pack(values, jnp.zeros((d.topology.nv, size), like.dtype))


def row(like: jax.Array, *lanes: Any) -> jax.Array:
    """Vectors of lanes of one link, one after another, as an array."""
    flat = [x for some in lanes for x in some]
    return pack(flat, jnp.zeros(len(flat), like.dtype))


def kernel(f: Callable, *args: jax.Array) -> jax.Array:
    """f(*args) of a sample, as a kernel whose results have the batch first."""
    return batch_first(threaded(f)(*(batch_last(args) if TURNED else args)))


def by_column(model: Model, rows: jax.Array, column: Callable) -> list[jax.Array]:
    """Matrices (n, n) whose columns j are column(row of link j, which links it moves, unit vector);
    column may close over the rows of all."""
    n = model.nv

    def of_link(own: jax.Array, places: jax.Array, j: jax.Array) -> Sequence[jax.Array]:
        return column(own, places, jnp.where(np.arange(n) == j, 1.0, 0.0).astype(own.dtype))

    # the threads of a sample read neighbours of each column of `places`
    places = jnp.asarray(which_moves(model.topology).T)
    return side_by_side(of_link, [rows, places, jnp.arange(n, dtype=np.int32)], [0, 1, 0])


def pair_columns_of(
    firsts: Sequence[tuple], seconds: jax.Array, places: jax.Array
) -> list[jax.Array]:
    """Columns of matrices over pairs of links. firsts: for each matrix the two vectors of all links
    that entries are products of, (n, lanes); seconds: of the column's link, in the same order."""
    out, start = [], 0
    for pair in firsts:
        halves = []
        for all_links in pair:
            count = all_links.shape[1]
            own = [seconds[start + k] for k in range(count)]
            halves.append(([all_links[:, k] for k in range(count)], own))
            start += count
        out.append(pair_column(*halves, places))
    return out


def solved(model: Model, rows: jax.Array, x: jax.Array) -> jax.Array:
    """M^-1 x from the factors in world axes: rows of (S, U, 1 / D)."""
    d = Unrolled(model, None)
    factors = [
        Factor(UNMOVED, Motion.from_lanes(y[:6]), Force.from_lanes(y[6:12]), y[12])
        for y in ([r[k] for k in range(13)] for r in rows)
    ]
    return d.pack(solve(d, factors, d.lanes(x)), x)
