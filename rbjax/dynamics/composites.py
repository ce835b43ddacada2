"""Links in world axes, sums over what each of them carries, and matrices over pairs of links.

Each tree is seen from the origin of its own first link, so that f32 keeps its digits. A matrix such
as M or C has entries only where one link carries the other, and there the deeper one decides.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers import Driver, Unrolled
from rbjax.dynamics.kinematics import world_poses
from rbjax.lanes import Lane, Mat3, Sym3, Vec3, add, inner, sub
from rbjax.materialize import materialize
from rbjax.model import Topology
from rbjax.spatial import Force, Motion, RigidInertia, Transform


def tree_poses(d: Driver, joints: Any) -> Any:
    """Each link's pose in world axes, from the origin of its tree's first link."""
    poses = d.whole(world_poses(d, joints))
    origins = d.take(poses, [chain[0] for chain in d.topology.ancestors])
    return d.each(lambda pose, origin: Transform(pose.R, pose.p - origin.p), poses, origins)


def link_axes(d: Driver, poses: Any) -> Any:
    """Each link's axis S in world axes."""

    def axis(pose, turns):
        z = pose.R.columns[2]
        return Motion(z * turns, pose.p.cross(z * turns) + z * sub(1.0, turns))

    turns = d.known([1.0 if link.kind == "hinge" else 0.0 for link in d.topology.links])
    return d.each(axis, poses, turns)


def link_twists(d: Driver, S: Any, v: jax.Array) -> tuple[Any, Any]:
    """Each link's twist V in world axes, and the rate of its axis, S' = T x S.

    T is the link's own twist; the axes of a ball turn with its body, so theirs is that of its last
    link.
    """

    def step(x, V_parent):
        S, speed = x
        V = V_parent + S * speed
        return V, V

    V = d.whole(d.outward(step, Motion.zero(), d.zip(d.rows(S), d.lanes(v))))
    turning = d.take(V, [last_of_ball(d.topology, i) for i in range(d.topology.nv)])
    return V, d.each(Motion.cross, turning, S)


def last_of_ball(top: Topology, i: int) -> int:
    """The last link of the ball that the link belongs to; else the link itself."""
    link = top.links[i]
    return i if link.part is None or link.kind == "slide" else i + 2 - link.part


def link_inertias(d: Driver, poses: Any) -> Any:
    """Each link's own inertia in world axes."""
    return d.each(
        lambda pose, link: pose.rigid_to_parent(link.inertia), poses, d.whole(d.constants)
    )


def coriolis_block(inertia: RigidInertia, V: Motion) -> tuple[Sym3, Force]:
    """B(I, V) = [D - [n], 0; -2 [f], 0] / 2 as (D, [n; f]), with [n; f] = I V the momentum and

    D = [w] J - J [w] - [u] [h] - [h] [u] symmetric; so B V = V x* I V and B + B^T = dI/dt.
    """
    W, U, H = (Mat3.skew(x) for x in (V.ang, V.lin, inertia.h))
    half = W @ inertia.J - (U @ H)
    return Sym3.upper(half + half.T), inertia(V)


def twice_coriolis(block: tuple[Sym3, Force], w: Vec3) -> Force:
    """2 B [w; u], whatever u is."""
    D, h = block
    return Force(D @ w - h.ang.cross(w), w.cross(h.lin) * 2.0)


def twice_coriolis_transposed(block: tuple[Sym3, Force], S: Motion) -> Vec3:
    """2 B^T S, whose linear part is zero."""
    D, h = block
    return D @ S.ang + h.ang.cross(S.ang) + h.lin.cross(S.lin) * 2.0


def carried(d: Driver, values: Any, zero: Any) -> Any:
    """For each link the sum of the values of all links that it carries, itself included."""

    def step(own, children):
        total = jax.tree.map(add, own, children)
        return total, total

    return d.whole(d.inward(step, zero, d.rows(values)))


def pair_matrix(d: Driver, above: Any, below: Any, like: jax.Array) -> jax.Array:
    """(nv, nv): entry (i, j) is a_i . b_j, zero where neither link moves the other.

    (a, b) are `below` where j moves i (`movers`), else `above`; vectors of lanes.
    """
    top = d.topology
    n = top.nv
    if isinstance(d, Unrolled):
        return packed(d, pair_entries(d, above, below), like)
    moves = np.zeros((n, n), bool)
    for i in range(n):
        moves[i, movers(top, i)] = True
    above, below = jax.tree.map(
        lambda x: jnp.broadcast_to(jnp.asarray(x, like.dtype), (n,)),
        tuple((list(a), list(b)) for a, b in (above, below)),
    )

    def products(a, b):
        # a transposed operand would keep the sum from being vectorized: hence no mirror
        return functools.reduce(
            jnp.add, (x[:, None] * y[None, :] for x, y in zip(a, b, strict=True))
        )

    return jnp.where(moves, products(*below), jnp.where(moves.T, products(*above), 0.0))


def pair_columns(d: Driver, above: Any, below: Any, like: jax.Array) -> Any:
    """The same column by column: lists of lanes, or an array."""
    if isinstance(d, Unrolled):
        rows = pair_entries(d, above, below)
        return materialize([[row[j] for row in rows] for j in range(len(rows))])
    return pair_matrix(d, above, below, like).T


def with_armature(d: Driver, M: jax.Array) -> jax.Array:
    """M with the armature of the joints on its diagonal."""
    armature = jnp.asarray(d.prepared.columns.armature)
    return M + jnp.where(np.eye(d.topology.nv, dtype=bool), armature, 0.0).astype(M.dtype)


def pair_entries(d: Unrolled, above: Any, below: Any) -> list[list[Lane]]:
    """The entries of `pair_matrix`, row by row."""
    n = d.topology.nv
    entries: list[list[Lane]] = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for j in movers(d.topology, i):
            entries[i][j] = inner(below[0][i], below[1][j])
            if i not in movers(d.topology, j):
                entries[j][i] = inner(above[0][j], above[1][i])
    return entries


def packed(d: Unrolled, rows: list[list[Lane]], like: jax.Array) -> jax.Array:
    """Rows of lanes as a matrix."""
    flat = [x for row in rows for x in row]
    return d.pack(flat, jnp.zeros(len(flat), like.dtype)).reshape(len(rows), -1)


def movers(top: Topology, i: int) -> list[int]:
    """The links whose coordinates move link i: those that carry it, itself, and all of its ball."""
    return list(top.ancestors[last_of_ball(top, i)])
