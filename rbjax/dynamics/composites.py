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

from rbjax.dynamics.drivers import Driver, Listed
from rbjax.dynamics.jacobians import ancestor_mask
from rbjax.dynamics.kinematics import world_poses
from rbjax.dynamics.packing import pack
from rbjax.lanes import Lane, add, inner, sub
from rbjax.model import Topology
from rbjax.spatial import Motion, Transform


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


def link_inertias(d: Driver, poses: Any) -> Any:
    """Each link's own inertia in world axes."""
    return d.each(
        lambda pose, link: pose.rigid_to_parent(link.inertia), poses, d.whole(d.constants)
    )


def carried(d: Driver, values: Any, zero: Any) -> Any:
    """For each link the sum of the values of all links that it carries, itself included."""

    def step(own, children):
        total = jax.tree.map(add, own, children)
        return total, total

    return d.whole(d.inward(step, zero, d.rows(values)))


def pair_matrix(d: Driver, above: Any, below: Any, like: jax.Array) -> jax.Array:
    """(nv, nv): entry (i, j) is a_i . b_j, zero where neither link carries the other.

    (a, b) are `above` where i carries j or is j, `below` where j carries i; vectors of lanes.
    """
    top = d.topology
    n = top.nv
    if isinstance(d, Listed):
        entries = [[0.0] * n for _ in range(n)]
        for i, chain in enumerate(top.ancestors):
            for j in chain:
                entries[i][j] = inner(below[0][i], below[1][j])
                entries[j][i] = inner(above[0][j], above[1][i])
        return packed_matrix(entries, like)
    moves = carrier_mask(top)
    above, below = jax.tree.map(
        lambda x: jnp.broadcast_to(jnp.asarray(x, like.dtype), (n,)),
        tuple((list(a), list(b)) for a, b in (above, below)),
    )

    def products(a, b):
        # a transposed operand would keep the sum from being vectorized: hence no mirror
        return functools.reduce(
            jnp.add, (x[:, None] * y[None, :] for x, y in zip(a, b, strict=True))
        )

    return jnp.where(moves.T, products(*above), jnp.where(moves, products(*below), 0.0))


def packed_matrix(rows: list[list[Lane]], like: jax.Array) -> jax.Array:
    """Rows of lanes as a matrix."""
    entries = [x for row in rows for x in row]
    return pack(entries, jnp.zeros(len(entries), like.dtype)).reshape(len(rows), -1)


def carrier_mask(top: Topology) -> np.ndarray:
    """(nv, nv): whether link j carries link i, or is it."""
    return np.stack([ancestor_mask(top, i) for i in range(top.nv)])
