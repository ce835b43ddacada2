"""Derivatives of dynamics column by column, with one GPU thread for each column.

The n x n entries of a humanoid need too long a program and too many registers for one thread.
Therefore a first kernel, with one thread for each sample, writes a row of numbers for each link. In
a second kernel each thread computes one column of all matrices, from the row of its own link and
the rows of all links. M^-1 x is an inward and an outward sweep over the factors of ABA. All vectors
are in world axes. The formulas are in `aba`, `operands` and `pair_column`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler import compile_threads, map_threads
from rbjax.dynamics.algorithms.aba import aba, factorize, solve
from rbjax.dynamics.algorithms.composites import inverse_pairs, link_axes, operands, tree_poses
from rbjax.dynamics.algorithms.factors import Factor
from rbjax.dynamics.drivers.choice import Driver, driver, on_threads
from rbjax.dynamics.drivers.pairs import pair_column, which_moves
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.lanes import Lane, Mat3, Vec3, batch_first, batch_last
from rbjax.lanes.arrays import pack
from rbjax.model import Model, prepare
from rbjax.model.cells import stacked
from rbjax.spatial import Force, Motion, Transform

#: slices of a row: axis S, then U and 1 / D if M^-1 is applied to the columns
AXIS, FACTORS = slice(0, 6), slice(6, 13)
#: starts of the factors of `pair_matrix` in a row of inverse and of forward dynamics, and the
#: length of `Operands.row`, which the second factors follow
INVERSE, FORWARD, BELOW = 6, 13, 9
UNMOVED = Transform(Mat3.identity(), Vec3.zero())


def inverse_rows(model: Model, q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """Compute, by link, the row of numbers that the second kernel of `inverse_by_columns` reads."""
    d = driver(model, q.dtype)
    joints = d.joints(q, None)
    poses = tree_poses(d, joints)
    S = link_axes(d, poses, joints)

    def row(pose, S, x):
        return _packed(v, S, x.row, *_seconds(inverse_pairs(S, x)))

    out = operands(d, poses, S, v, d.lanes(a), row)
    return d.pack(out, jnp.zeros((model.nv, INVERSE + BELOW + 42), v.dtype))


def accelerations(model: Model, q: jax.Array, v: jax.Array, tau: jax.Array) -> jax.Array:
    """Compute the rows [qdd; 1 / D; U] (8, nv): joint accelerations, and factors of ABA."""
    d = driver(model, q.dtype)
    a, factors = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity)
    _, _, U, inverse_D = d.unzip(factors, 4)
    return _lane_rows(d, d.zip(a, inverse_D, U), v)


def forward_rows(model: Model, q: jax.Array, v: jax.Array, found: jax.Array) -> jax.Array:
    """Compute, by link, the row of numbers that the last kernel of `forward_by_columns` reads.
    found: the result of `accelerations`."""
    d = driver(model, q.dtype)
    a, inverse_D, *U = map(d.lanes, found)
    joints = d.joints(q, None)
    poses = tree_poses(d, joints)
    S = link_axes(d, poses, joints)

    def row(pose, S, x, inverse_D, U):
        U = pose.T(Force.from_lanes(U))
        return _packed(v, S, U, [inverse_D], x.row, *_seconds(inverse_pairs(S, x)[:2]))

    out = operands(d, poses, S, v, a, row, inverse_D, d.zip(*U))
    return d.pack(out, jnp.zeros((model.nv, FORWARD + BELOW + 30), v.dtype))


def inverse_mass_rows(model: Model, q: jax.Array) -> jax.Array:
    """Compute the pose X and the ABA factors U and 1 / D of each link as an array (19, nv).

    The axis S is appended if it varies.

    They are in the axes of the link, in which float32 keeps more digits than in world axes.
    """
    d = driver(model, q.dtype)
    X, S, U, inverse_D = d.unzip(factorize(d, d.joints(q, None)), 4)
    moving = () if model.topology.constant_axes else (S,)
    return _lane_rows(d, d.zip(X, U, inverse_D, *moving), q[:1])


def _lane_rows(d: Driver, values: Any, like: jax.Array) -> jax.Array:
    like = jnp.zeros(d.topology.nv, like.dtype)
    return jnp.stack(jax.tree.leaves(d.columns(values, like)))


def _seconds(pairs: tuple) -> list:
    """Return the second vector b of each pair (a, b) of `pair_matrix`, in order."""
    return [b for pair in pairs for _, b in pair]


def _packed(like: jax.Array, *vectors: Any) -> jax.Array:
    flat = [x for lanes in vectors for x in lanes]
    return pack(flat, jnp.zeros(len(flat), like.dtype))


# ------------------------------------------------------------------- kernels


def inverse_by_columns(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array
) -> tuple[jax.Array, ...]:
    """Compute `inverse_dynamics_derivatives` with two kernels."""
    model = on_threads(model, q.dtype)
    rows = _kernel(lambda *x: inverse_rows(model, *x), q, v, a)
    armature = stacked(prepare(model, v.dtype).columns.armature, v.dtype)

    def column(own, places, unit):
        x = _entries(rows, own, places, INVERSE, 3)
        by_q, by_v, M = (jnp.stack(lanes) for lanes in zip(*x, strict=True))
        return [by_q, by_v, M + unit * armature]

    return tuple(_by_column(model, rows, column))


def forward_by_columns(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array
) -> tuple[jax.Array, ...]:
    """Compute `forward_dynamics_derivatives` with three kernels."""
    model = on_threads(model, q.dtype)
    found = compile_threads(lambda *x: accelerations(model, *x))(*batch_last((q, v, tau)))
    rows = _kernel(lambda *x: forward_rows(model, *x), q, v, found)
    return forward_columns(model, rows)


def forward_columns(model: Model, rows: jax.Array) -> tuple[jax.Array, ...]:
    """Compute the derivatives of forward dynamics from the result of `forward_rows`."""
    inward, outward = batch_first((rows, rows))

    def column(own, places, unit):
        x = _entries(rows, own, places, FORWARD, 2)
        both = [jnp.stack([*lanes, one]) for lanes, one in zip(x, unit, strict=True)]
        solved = _solved(model, _factors(inward), _factors(outward), jnp.stack(both))
        return [-solved[:, 0], -solved[:, 1], solved[:, 2]]

    return tuple(_by_column(model, rows, column))


def inverse_mass_by_columns(model: Model, q: jax.Array) -> jax.Array:
    """Compute `inverse_mass_matrix` with two kernels."""
    model = on_threads(model, q.dtype)
    rows = _kernel(lambda q: inverse_mass_rows(model, q), q)
    inward, outward = batch_first((rows, rows))

    prepared, links = prepare(model, q.dtype), enumerate(model.topology.dofs)
    axes = [
        link.kind.axis(prepared.link(i).params) if link.kind.constant_axis else None
        for i, link in links
    ]

    def factors(rows):
        lanes = [_lanes(rows[:, i], slice(None)) for i in range(model.nv)]
        return [
            Factor(
                Transform(Mat3(*x[:9]), Vec3(*x[9:12])),
                Motion.from_lanes(x[19:]) if S is None else S,
                Force.from_lanes(x[12:18]),
                x[18],
            )
            for S, x in zip(axes, lanes, strict=True)
        ]

    def column(j):
        unit = _unit(model, j, q)
        return [_solved(model, factors(inward), factors(outward), unit)]

    return map_threads(column, [_numbers(model)], [0])[0]


def _kernel(f: Callable, *args: jax.Array) -> jax.Array:
    """Run a function f(*args) of one sample as a kernel. The results have the batch first."""
    return batch_first(compile_threads(f)(*args))


def _by_column(model: Model, rows: jax.Array, column: Callable) -> list[jax.Array]:
    """Compute matrices (nv, nv) with one thread for each column j.

    rows: row of numbers of each link.
    column: function (row of link j, column j of `which_moves`, unit vector j) that returns column j
        of each matrix.
    """

    def of_link(own: jax.Array, places: jax.Array, j: jax.Array) -> list[jax.Array]:
        return column(own, places, _unit(model, j, own))

    # transposed: numbers that threads read at the same time are adjacent in memory
    places = jnp.asarray(which_moves(model.topology).T)
    return map_threads(of_link, [rows, places, _numbers(model)], [0, 1, 0])


def _numbers(model: Model) -> jax.Array:
    return jnp.arange(model.nv, dtype=np.int32)


def _unit(model: Model, j: jax.Array, like: jax.Array) -> jax.Array:
    return jnp.where(np.arange(model.nv) == j, 1.0, 0.0).astype(like.dtype)


def _entries(
    rows: jax.Array, own: jax.Array, places: jax.Array, start: int, count: int
) -> list[list[Lane]]:
    """Compute, link by link, the entries of one column of `count` matrices `pair_matrix`.

    rows: the numbers of all links. own: the numbers of the link of the column.
    places: for each link, its entry in this column of `which_moves`.
    start: index of the first number of a link's vectors.
    """
    out: list[list[Lane]] = []
    for row in rows:
        S, below = _lanes(row, AXIS), _lanes(row, slice(start, start + BELOW))
        firsts = [(S, below), (S, below), (S, below[:6])][:count]
        rest = iter(_lanes(own, slice(start + BELOW, None)))
        place = places[len(out)]
        pairs = [[(half, [next(rest) for _ in half]) for half in pair] for pair in firsts]
        out.append([pair_column(above, below, place) for above, below in pairs])
    return out


def _lanes(row: jax.Array, some: slice) -> list[Lane]:
    return [row[k] for k in range(*some.indices(row.shape[0]))]


def _factors(rows: jax.Array) -> list[Factor]:
    """Read the ABA factors of all links, in world axes, from their rows of numbers."""

    def factor(row):
        S, (*U, inverse_D) = _lanes(row, AXIS), _lanes(row, FACTORS)
        return Factor(UNMOVED, Motion.from_lanes(S), Force.from_lanes(U), inverse_D)

    return [factor(row) for row in rows]


def _solved(model: Model, inward: list, outward: list, x: jax.Array) -> jax.Array:
    """Compute M^-1 x for columns x (nv, ...) by an inward and an outward sweep.
    inward, outward: the ABA factors, once for each sweep."""
    d = Unrolled(model, None)
    return d.pack(solve(d, inward, d.lanes(x), outward), x)
