"""Derivatives of dynamics column by column, with one GPU thread a column.

The n x n entries of a humanoid are too long a program for one thread, and need too many registers.
So a first kernel, with one thread a sample, writes a row of numbers for each link. In a second
kernel each thread computes one column of all matrices, from its own link's row and the rows of all
links, which the threads of a sample read together. M^-1 x is an inward and an outward sweep over
ABA's factors, all in world axes. The formulas are those of ABA, `operands` and `pair_column`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.compiler import compile_threads, map_threads
from rbjax.dynamics.algorithms.aba import Factor, aba, factorize, solve
from rbjax.dynamics.algorithms.composites import inverse_pairs, link_axes, operands, tree_poses
from rbjax.dynamics.drivers.choice import Driver, driver, on_threads
from rbjax.dynamics.drivers.pairs import pair_column, which_moves
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.lanes import Lane, Mat3, Vec3, batch_first, batch_last
from rbjax.lanes.arrays import pack
from rbjax.model import Model, prepare
from rbjax.model.cells import stacked
from rbjax.spatial import Force, Motion, Transform

#: a row: axis S, then U and 1 / D if columns are solved, all in world axes
AXIS, FACTORS = slice(0, 6), slice(6, 13)
#: and then the factors of `pair_matrix`: the row of `Operands`, and the second factors
INVERSE, FORWARD, BELOW = 6, 13, 9
UNMOVED = Transform(Mat3.identity(), Vec3.zero())


def inverse_rows(model: Model, q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """The row of each link for the derivatives of inverse dynamics."""
    d = driver(model, q.dtype)
    joints = d.joints(q, None)
    poses = tree_poses(d, joints)
    S = link_axes(d, poses, joints)

    def row(pose, S, x):
        return _packed(v, S, x.row, *_seconds(inverse_pairs(S, x)))

    out = operands(d, poses, S, v, d.lanes(a), row)
    return d.pack(out, jnp.zeros((model.nv, INVERSE + BELOW + 42), v.dtype))


def accelerations(model: Model, q: jax.Array, v: jax.Array, tau: jax.Array) -> jax.Array:
    """a, 1 / D and U of each link in its own axes, as an array (8, nv)."""
    d = driver(model, q.dtype)
    a, factors = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity)
    _, _, U, inverse_D = d.unzip(factors, 4)
    return _lane_rows(d, d.zip(a, inverse_D, U), v)


def forward_rows(model: Model, q: jax.Array, v: jax.Array, found: jax.Array) -> jax.Array:
    """The row of each link for the derivatives of forward dynamics, from `accelerations`."""
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
    """X, U and 1 / D of each link in its own axes, where f32 keeps more digits, as (19, nv); then
    S, if the axes depend on q."""
    d = driver(model, q.dtype)
    X, S, U, inverse_D = d.unzip(factorize(d, d.joints(q, None)), 4)
    moving = () if model.topology.constant_axes else (S,)
    return _lane_rows(d, d.zip(X, U, inverse_D, *moving), q[:1])


def _lane_rows(d: Driver, values: Any, like: jax.Array) -> jax.Array:
    like = jnp.zeros(d.topology.nv, like.dtype)
    return jnp.stack(jax.tree.leaves(d.columns(values, like)))


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
    armature = stacked(prepare(model, v.dtype).columns.armature, v.dtype)

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
    found = compile_threads(lambda *x: accelerations(model, *x))(*batch_last((q, v, tau)))
    rows = _kernel(lambda *x: forward_rows(model, *x), q, v, found)
    return forward_columns(model, rows)


def forward_columns(model: Model, rows: jax.Array) -> tuple[jax.Array, ...]:
    """The matrices from the rows of the links."""
    inward, outward = batch_first((rows, rows))

    def column(own, places, unit):
        x = _entries(rows, own, places, FORWARD, 2)
        both = [jnp.stack([*lanes, one]) for lanes, one in zip(x, unit, strict=True)]
        solved = _solved(model, _factors(inward), _factors(outward), jnp.stack(both))
        return [-solved[:, 0], -solved[:, 1], solved[:, 2]]

    return tuple(_by_column(model, rows, column))


def inverse_mass_by_columns(model: Model, q: jax.Array) -> jax.Array:
    """`inverse_mass_matrix` as two kernels."""
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
    """Run f(*args) of one sample as a kernel whose results have the batch first."""
    return batch_first(compile_threads(f)(*args))


def _by_column(model: Model, rows: jax.Array, column: Callable) -> list[jax.Array]:
    """Matrices (nv, nv) whose columns j are column(row of link j, its column of `which_moves`, unit
    vector j)."""

    def of_link(own: jax.Array, places: jax.Array, j: jax.Array) -> list[jax.Array]:
        return column(own, places, _unit(model, j, own))

    # numbers that the threads of a sample read at the same time lie side by side
    places = jnp.asarray(which_moves(model.topology).T)
    return map_threads(of_link, [rows, places, _numbers(model)], [0, 1, 0])


def _numbers(model: Model) -> jax.Array:
    return jnp.arange(model.nv, dtype=np.int32)


def _unit(model: Model, j: jax.Array, like: jax.Array) -> jax.Array:
    return jnp.where(np.arange(model.nv) == j, 1.0, 0.0).astype(like.dtype)


def _entries(
    rows: jax.Array, own: jax.Array, places: jax.Array, start: int, count: int
) -> list[list[Lane]]:
    """The entries of one column of `count` matrices, link by link."""
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
    """The factors of M in world axes."""

    def factor(row):
        S, (*U, inverse_D) = _lanes(row, AXIS), _lanes(row, FACTORS)
        return Factor(UNMOVED, Motion.from_lanes(S), Force.from_lanes(U), inverse_D)

    return [factor(row) for row in rows]


def _solved(model: Model, inward: list, outward: list, x: jax.Array) -> jax.Array:
    """Compute M^-1 x for columns x (nv, ...). A second copy of the factors for the outward sweep
    saves registers."""
    d = Unrolled(model, None)
    return d.pack(solve(d, inward, d.lanes(x), outward), x)
