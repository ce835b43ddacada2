"""Links in world axes, and sums over the links that each of them carries.

The origin of each tree is that of its first link, so that f32 keeps its digits.
"""

from __future__ import annotations

from typing import Any

import jax

from rbjax.dynamics.drivers import Driver
from rbjax.dynamics.joints import axes, own_axes
from rbjax.dynamics.kinematics import world_poses
from rbjax.lanes import Mat3, Sym3, Vec3, add
from rbjax.spatial import Force, Motion, RigidInertia, Transform


def tree_poses(d: Driver, joints: Any) -> Any:
    """Each link's pose in world axes, from the origin of its tree's first link."""
    poses = d.whole(world_poses(d, joints))
    origins = d.take(poses, [chain[0] for chain in d.topology.ancestors])
    return d.each(lambda pose, origin: Transform(pose.R, pose.p - origin.p), poses, origins)


def link_axes(d: Driver, poses: Any, joints: Any) -> Any:
    """Each link's axis S in world axes."""
    return d.each(Transform.motion_to_parent, poses, own_axes(d, joints))


def axis_rates(d: Driver, V: Any, S: Any, poses: Any, joints: Any) -> Any:
    """S' of each link in world axes."""
    moved = d.each(Motion.cross, turning(d, V), S)
    if d.topology.straight:
        return moved
    own = d.whole(axes(d, joints)[1])
    return d.each(lambda moved, pose, own: moved + pose.motion_to_parent(own), moved, poses, own)


def link_twists(d: Driver, S: Any, v: jax.Array) -> Any:
    """Each link's twist V in world axes."""

    def step(x, V_parent):
        S, speed = x
        V = V_parent + S * speed
        return V, V

    return d.whole(d.outward(step, Motion.zero(), d.zip(d.rows(S), d.lanes(v))))


def turning(d: Driver, V: Any) -> Any:
    """The twist T with S' = T x S of each link's axis. It is the twist of the link itself. For the
    three links of a ball it is that of the last, because their axes are fixed in the body."""
    return d.take(V, [link.node[-1] for link in d.topology.links])


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
    """2 B [w; u], which does not depend on u."""
    D, h = block
    return Force(D @ w - h.ang.cross(w), w.cross(h.lin) * 2.0)


def twice_coriolis_transposed(block: tuple[Sym3, Force], S: Motion) -> Vec3:
    """2 B^T S, whose linear part is zero."""
    D, h = block
    return D @ S.ang + h.ang.cross(S.ang) + h.lin.cross(S.lin) * 2.0


def carried(d: Driver, values: Any, zero: Any) -> Any:
    """For each link, the sum of the values of all links that it carries, itself included."""

    def step(own, children):
        total = jax.tree.map(add, own, children)
        return total, total

    return d.whole(d.inward(step, zero, d.rows(values)))
