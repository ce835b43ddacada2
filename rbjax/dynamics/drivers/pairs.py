"""Matrices over pairs of links.

In a matrix such as M or C an entry (i, j) is nonzero only if one of the links i and j moves the
other. The entry is the inner product of six to nine lanes of each link. Different lanes are used if
i moves j than if j moves i.
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
    """Return the links that move link i: i, its ancestors and the dofs that share its frame."""
    return list(top.ancestors[top.dofs[i].node[-1]])


def pair_matrix(d: Driver, above: Any, below: Any, like: jax.Array) -> jax.Array:
    """Compute a matrix (nv, nv) with the entries a_i . b_j, or zero if neither link moves the
    other.

    below: vectors (a, b) of each link, used if link j moves link i (`movers`).
    above: vectors (a, b) of each link, used if only link i moves link j.
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
    """Compute the entries of `pair_matrix` as lanes, row by row."""
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
    """Return a function f and arrays xs to compute matrices `pair_matrix` column by column.
    For slice j of xs along the first axis, f returns column j (n,) of the matrix of each pair."""
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
    """Compute a column of `pair_matrix` as an array (n,).

    Args:
        above, below: pairs (a, b) as in `pair_matrix`: the lanes of a are arrays (n,) over all
            links, and the lanes of b belong to the link of the column.
        places: the row (n,) of this link in `which_moves`.
    """
    upper, lower = (
        functools.reduce(jnp.add, [x * y for x, y in zip(*half, strict=True)])
        for half in (above, below)
    )
    return jnp.where(places == 2, lower, jnp.where(places == 1, upper, 0.0))


def which_moves(top: Topology) -> np.ndarray:
    """Return the matrix with entry (j, i) = 2 if link j moves i, 1 if only i moves j, else 0."""
    moves = _moves(top)
    return np.where(moves.T, 2, moves).astype(np.int32)


def _columns(top: Topology, pairs: Any, like: jax.Array) -> tuple[np.ndarray, Any]:
    """Return the mask (nv, nv) of links that move each other, and the lanes of `pairs` as arrays
    (nv,)."""

    def spread(v):
        return [jnp.broadcast_to(jnp.asarray(x, like.dtype), (top.nv,)) for x in v]

    return _moves(top), [[[spread(v) for v in half] for half in pair] for pair in pairs]


def _moves(top: Topology) -> np.ndarray:
    """Return the mask (nv, nv) whose entry (i, j) is True if link j moves link i."""
    moves = np.zeros((top.nv, top.nv), bool)
    for i in range(top.nv):
        moves[i, movers(top, i)] = True
    return moves


def with_armature(d: Driver, M: jax.Array) -> jax.Array:
    """Add the armature of the joints to the diagonal of M."""
    armature = stacked(d.prepared.columns.armature, M.dtype)
    return M + jnp.where(np.eye(d.topology.nv, dtype=bool), armature, 0.0)
