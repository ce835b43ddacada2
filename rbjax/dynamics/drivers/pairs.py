"""Matrices over pairs of links.

A matrix such as M or C has an entry (i, j) only where one link moves the other. The entry is a
product of six to nine lanes of each link, which depend on which link is deeper.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers.choice import Driver
from rbjax.lanes import Lane, inner
from rbjax.lanes.arrays import pack
from rbjax.model import Topology
from rbjax.model.cells import stacked


def movers(top: Topology, i: int) -> list[int]:
    """The links whose coordinates move link i: its ancestors and the dofs that share its frame."""
    return list(top.ancestors[top.dofs[i].node[-1]])


def pair_matrix(d: Driver, above: Any, below: Any, like: jax.Array) -> jax.Array:
    """(nv, nv): entry (i, j) is a_i . b_j, zero where neither link moves the other.

    (a, b) are `below` where j moves i (`movers`), else `above`; vectors of lanes.
    """
    if d.listed:
        return packed(pair_entries(d.topology, above, below), like)
    moves, [[above, below]] = _columns(d.topology, [(above, below)], like)

    def products(a, b):
        # no mirroring: a transposed operand would prevent vectorization of the sum
        return functools.reduce(
            jnp.add, (x[:, None] * y[None, :] for x, y in zip(a, b, strict=True))
        )

    return jnp.where(moves, products(*below), jnp.where(moves.T, products(*above), 0.0))


def pair_entries(top: Topology, above: Any, below: Any) -> list[list[Lane]]:
    """The entries of `pair_matrix`, row by row."""
    n = top.nv
    entries: list[list[Lane]] = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in movers(top, i):
            entries[i][j] = inner(below[0][i], below[1][j])
            if i not in movers(top, j):
                entries[j][i] = inner(above[0][j], above[1][i])
    return entries


def packed(rows: list[list[Lane]], like: jax.Array) -> jax.Array:
    """Pack rows of lanes as a matrix."""
    flat = [x for row in rows for x in row]
    return pack(flat, jnp.zeros(len(flat), like.dtype)).reshape(len(rows), -1)


def pair_columns(top: Topology, pairs: Sequence[Any], like: jax.Array) -> tuple[Callable, Any]:
    """Return f and xs, such that f(slice j of xs) is column j of each matrix (above, below)."""
    _, arrays = _columns(top, pairs, like)
    columns = [x for (_, b), (_, e) in arrays for x in (*b, *e)]

    def at(x):
        places, lanes = x
        own = iter([lanes[k] for k in range(len(columns))])

        def half(rows, _):
            return rows, [next(own) for _ in rows]

        halves = [[half(*x) for x in pair] for pair in arrays]
        return [pair_column(above, below, places) for above, below in halves]

    return at, (which_moves(top), jnp.stack(columns, -1))


def pair_column(above: Any, below: Any, places: jax.Array) -> jax.Array:
    """A column of `pair_matrix` as an array (n,).

    Args:
        above, below: the lanes of all links as arrays (n,), and those of the column's link.
        places: the row of the column's link in `which_moves`.
    """
    upper, lower = (
        functools.reduce(jnp.add, [x * y for x, y in zip(*half, strict=True)])
        for half in (above, below)
    )
    return jnp.where(places == 2, lower, jnp.where(places == 1, upper, 0.0))


def which_moves(top: Topology) -> np.ndarray:
    """Entry (j, i) is 2 if link j moves link i, else 1 if i moves j, else 0."""
    moves = _moves(top)
    return np.where(moves.T, 2, moves).astype(np.int32)


def _columns(top: Topology, pairs: Any, like: jax.Array) -> tuple[np.ndarray, Any]:
    """`_moves`, and all lanes as arrays (nv,)."""

    def spread(v):
        return [jnp.broadcast_to(jnp.asarray(x, like.dtype), (top.nv,)) for x in v]

    return _moves(top), [[[spread(v) for v in half] for half in pair] for pair in pairs]


def _moves(top: Topology) -> np.ndarray:
    """Entry (i, j) is whether link j moves link i."""
    moves = np.zeros((top.nv, top.nv), bool)
    for i in range(top.nv):
        moves[i, movers(top, i)] = True
    return moves


def with_armature(d: Driver, M: jax.Array) -> jax.Array:
    """M with the armature of the joints on its diagonal."""
    armature = stacked(d.prepared.columns.armature, M.dtype)
    return M + jnp.where(np.eye(d.topology.nv, dtype=bool), armature, 0.0)
