"""Derivatives of dynamics column by column, a GPU thread a column.

For one thread the n x n entries of a humanoid are too long a program, and too much to hold. So a
first kernel, one thread a sample, leaves a row of numbers for each link; in a second each thread
makes one column of all matrices, from the rows of all links, which the threads of a sample read
together, and its own link's. M^-1 x is a sweep inward and one outward over ABA's factors, all of
them in world axes. Beside ABA, `operands` and `pair_column` there is nothing new in it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.aba import Factor, aba, factorize, solve
from rbjax.dynamics.composites import link_axes, tree_poses
from rbjax.dynamics.drivers import driver, on_threads
from rbjax.dynamics.operands import inverse_pairs, operands
from rbjax.dynamics.packing import pack
from rbjax.dynamics.pairs import pair_column, which_moves
from rbjax.dynamics.unrolled import Unrolled
from rbjax.lanes import Lane, Mat3, Vec3
from rbjax.materialize import batch_first, batch_last
from rbjax.model import Model, prepare
from rbjax.spatial import Force, Motion, Transform
from rbjax.threads import side_by_side, threaded

#: designs to be timed: accelerations in a kernel of their own; rows of links written with the batch
#: last, and turned about by XLA; products with M^-1 by XLA
SPLIT, TURNED, PRODUCTS = True, False, False

#: a row: axis S, then where columns are solved U and 1 / D, all in world axes
AXIS, FACTORS = slice(0, 6), slice(6, 13)
#: and then what `pair_matrix` multiplies: the row of `Operands`, and the second factors
INVERSE, FORWARD, BELOW = 6, 13, 9
UNMOVED = Transform(Mat3.identity(), Vec3.zero())


def inverse_rows(model: Model, q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """Each link's row for the derivatives of inverse dynamics."""
    d = driver(model, q.dtype)
    poses = tree_poses(d, d.joints(q, None))
    S = link_axes(d, poses)

    def row(pose, S, x):
        return _packed(v, S, x.row, *_seconds(inverse_pairs(S, x)))

    out = operands(d, poses, S, v, d.lanes(a), row)
    return d.pack(out, jnp.zeros((model.nv, INVERSE + BELOW + 42), v.dtype))


def accelerations(model: Model, q: jax.Array, v: jax.Array, tau: jax.Array) -> jax.Array:
    """a, 1 / D and U of each link, in its own axes, as an array (8, nv)."""
    d = driver(model, q.dtype)
    a, factors = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity)
    _, _, U, inverse_D = d.unzip(factors, 4)
    return jnp.stack(jax.tree.leaves(d.columns(d.zip(a, inverse_D, U), v)))


def forward_rows(model: Model, q: jax.Array, v: jax.Array, found: jax.Array) -> jax.Array:
    """Each link's row for the derivatives of forward dynamics, from `accelerations`."""
    d = driver(model, q.dtype)
    a, inverse_D, *U = map(d.lanes, found)
    poses = tree_poses(d, d.joints(q, None))
    S = link_axes(d, poses)

    def row(pose, S, x, inverse_D, U):
        U = pose.T(Force.from_lanes(U))
        return _packed(v, S, U, [inverse_D], x.row, *_seconds(inverse_pairs(S, x)[:2]))

    out = operands(d, poses, S, v, a, row, inverse_D, d.zip(*U))
    return d.pack(out, jnp.zeros((model.nv, FORWARD + BELOW + 30), v.dtype))


def inverse_mass_rows(model: Model, q: jax.Array) -> jax.Array:
    """Each link's row for the inverse of the mass matrix."""
    d = driver(model, q.dtype)
    joints = d.joints(q, None)
    _, _, U, inverse_D = map(d.whole, d.unzip(factorize(d, joints), 4))
    poses = tree_poses(d, joints)

    def row(pose, S, U, inverse_D):
        return *S, *pose.T(U), inverse_D

    rows = d.each(row, poses, link_axes(d, poses), U, inverse_D)
    return d.stack(rows, list, q)


def _seconds(pairs: tuple) -> list:
    """The second factors of `pair_matrix`."""
    return [b for pair in pairs for _, b in pair]


def _packed(like: jax.Array, *vectors: Any) -> jax.Array:
    flat = [x for lanes in vectors for x in lanes]
    return pack(flat, jnp.zeros(len(flat), like.dtype))


# ------------------------------------------------------------------- kernels


def inverse_by_columns(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array
) -> tuple[jax.Array, ...]:
    """`inverse_dynamics_derivatives` as two kernels."""
    model = on_threads(model, q.dtype)
    rows = _kernel(lambda *x: inverse_rows(model, *x), q, v, a)
    armature = jnp.asarray(prepare(model, v.dtype).columns.armature, v.dtype)

    def column(own, places, unit):
        x = _entries(rows, own, places, INVERSE, 3)
        by_q, by_v, M = (jnp.stack(lanes) for lanes in zip(*x, strict=True))
        return [by_q, by_v, M + unit * armature]

    return tuple(_by_column(model, rows, column))


def forward_by_columns(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array
) -> tuple[jax.Array, ...]:
    """`forward_dynamics_derivatives` as three kernels."""
    model = on_threads(model, q.dtype)
    if SPLIT:
        found = threaded(lambda *x: accelerations(model, *x))(*batch_last((q, v, tau)))
        rows = _kernel(lambda *x: forward_rows(model, *x), q, v, found)
    else:
        rows = _kernel(
            lambda q, v, tau: forward_rows(model, q, v, accelerations(model, q, v, tau)), q, v, tau
        )
    return forward_columns(model, rows)


def forward_columns(model: Model, rows: jax.Array) -> tuple[jax.Array, ...]:
    """The matrices from the rows of the links."""
    inward, outward = batch_first((rows, rows))

    def column(own, places, unit):
        x = _entries(rows, own, places, FORWARD, 2)
        if PRODUCTS:
            one = _solved(model, inward, outward, unit[:, None])
            return [*(jnp.stack(lanes) for lanes in zip(*x, strict=True)), one[:, 0]]
        both = [jnp.stack([*lanes, one]) for lanes, one in zip(x, unit, strict=True)]
        by_q, by_v, inverse = _solved(model, inward, outward, jnp.stack(both)).T
        return [-by_q, -by_v, inverse]

    *out, inverse = _by_column(model, rows, column)
    if PRODUCTS:
        out = [-jnp.matmul(inverse, x, precision=jax.lax.Precision.HIGHEST) for x in out]
    return *out, inverse


def inverse_mass_by_columns(model: Model, q: jax.Array) -> jax.Array:
    """`inverse_mass_matrix` as two kernels."""
    model = on_threads(model, q.dtype)
    rows = _kernel(lambda q: inverse_mass_rows(model, q), q)
    inward, outward = batch_first((rows, rows))

    def column(j):
        return [_solved(model, inward, outward, _unit(model, j, q)[:, None])[:, 0]]

    return side_by_side(column, [_numbers(model)], [0])[0]


def _kernel(f: Callable, *args: jax.Array) -> jax.Array:
    """f(*args) of a sample, as a kernel whose results have the batch first."""
    return batch_first(threaded(f)(*(batch_last(args) if TURNED else args)))


def _by_column(model: Model, rows: jax.Array, column: Callable) -> list[jax.Array]:
    """Matrices (nv, nv) whose columns j are column(row of link j, its column of `which_moves`, unit
    vector j)."""

    def of_link(own: jax.Array, places: jax.Array, j: jax.Array) -> list[jax.Array]:
        return column(own, places, _unit(model, j, own))

    # what the threads of a sample read at a time lies side by side
    places = jnp.asarray(which_moves(model.topology).T)
    return side_by_side(of_link, [rows, places, _numbers(model)], [0, 1, 0])


def _numbers(model: Model) -> jax.Array:
    return jnp.arange(model.nv, dtype=np.int32)


def _unit(model: Model, j: jax.Array, like: jax.Array) -> jax.Array:
    return jnp.where(np.arange(model.nv) == j, 1.0, 0.0).astype(like.dtype)


def _entries(
    rows: jax.Array, own: jax.Array, places: jax.Array, start: int, count: int
) -> list[list[Lane]]:
    """Of so many matrices the entries in a column, link by link. What a link reads it has used
    before the next one."""
    out = []
    for row in rows:
        S, below = _lanes(row, AXIS), _lanes(row, slice(start, start + BELOW))
        firsts = [(S, below), (S, below), (S, below[:6])][:count]
        rest = iter(_lanes(own, slice(start + BELOW, None)))
        halves = [[(half, [next(rest) for _ in half]) for half in pair] for pair in firsts]
        out.append([pair_column(*pair, places[len(out)]) for pair in halves])
    return out


def _lanes(row: jax.Array, some: slice) -> list[Lane]:
    return [row[k] for k in range(*some.indices(row.shape[0]))]


def _solved(model: Model, inward: jax.Array, outward: jax.Array, x: jax.Array) -> jax.Array:
    """M^-1 x of columns (nv, columns). The rows come twice: what the way in has read is read again
    on the way out, rather than kept in registers."""
    d = Unrolled(model, None)

    def factor(row):
        S, (*U, inverse_D) = _lanes(row, AXIS), _lanes(row, FACTORS)
        return Factor(UNMOVED, Motion.from_lanes(S), Force.from_lanes(U), inverse_D)

    first, again = ([factor(row) for row in rows] for rows in (inward, outward))
    return d.pack(solve(d, first, d.lanes(x), again), x)
