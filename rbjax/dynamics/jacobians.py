"""Geometric Jacobians, and the generalized forces of wrenches on bodies.

    V = J(q) v;  column i is [z_i; z_i x (p - p_i)] for a hinge and [0; z_i] for a slide,
    tau = sum over bodies of J_b^T w_b                                       (virtual work)
Angular first, world axes, at a point of the body (Lynch & Park, *Modern Robotics*, 5.1).
"""

from __future__ import annotations

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.drivers import driver
from rbjax.dynamics.kinematics import body_poses, link_poses
from rbjax.dynamics.link_forces import generalized, on_links
from rbjax.errors import InputError
from rbjax.model import WORLD, Model, Topology
from rbjax.model.links import matrix_apply


def world_axes(top: Topology, R: jax.Array, p: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Each link's unit twist at the world's origin: angular and linear parts (nv, 3)."""
    z = R[:, :, 2]
    turns = np.array([link.kind == "hinge" for link in top.links])[:, None]
    return jnp.where(turns, z, 0.0), jnp.where(turns, jnp.cross(p, z), z)


def ancestor_mask(top: Topology, link: int) -> np.ndarray:
    """(nv,) which links move the given one."""
    mask = np.zeros(top.nv, bool)
    if link != WORLD:
        mask[list(top.ancestors[link])] = True
    return mask


@algorithm("q")
def jacobian(model: Model, q: jax.Array, body: str, point: jax.Array | None = None) -> jax.Array:
    """Jacobian (6, nv) of a point of a body: [angular; linear] in world axes, V = J v.

    Args:
        model: the robot.
        q: (nq,) configuration.
        body: its name.
        point: (3,) m in the body's frame; its origin if None.

    Returns:
        (6, nv).

    Raises:
        UnknownName: no such body. InputError: a wrong shape.

    Source: Lynch & Park, *Modern Robotics*, 5.1 (there at the world's origin).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rb.jacobian(model, model.default_state().q, "lower").shape
        (6, 2)
    """
    b = model.body(body)
    d = driver(model, q.dtype)
    if not model.nv:
        return jnp.zeros((6, 0), q.dtype)
    R, p = link_poses(d, q)
    poses = body_poses(d, R, p)
    if point is None:
        at = poses.p[b]
    else:
        point = jnp.asarray(point, q.dtype)
        if point.shape != (3,):
            raise InputError(f"jacobian: point has shape {point.shape}, expected (3,)")
        at = poses.p[b] + matrix_apply(poses.R[b], point)
    angular, linear = world_axes(model.topology, R, p)
    mask = ancestor_mask(model.topology, model.topology.body_links[b])[:, None]
    columns = jnp.concatenate([angular, linear + jnp.cross(angular, at)], -1)
    return jnp.where(mask, columns, 0.0).T


def moment_arms(
    top: Topology,
    R: jax.Array,
    p: jax.Array,
    bodies: Sequence[int],
    at: jax.Array,
    wrenches: jax.Array,
) -> jax.Array:
    """J_b^T w (k, nv) of k wrenches in world axes, each at a world point `at` (k, 3) of a body.

    R, p are the world poses of the links; `bodies` says which body each wrench acts on.
    """
    moment, force = wrenches[:, :3], wrenches[:, 3:]
    about_origin = jnp.concatenate([moment + jnp.cross(at, force), force], -1)
    axes = jnp.concatenate(world_axes(top, R, p), -1)
    moves = np.stack(
        [ancestor_mask(top, WORLD if b == WORLD else top.body_links[b]) for b in bodies]
    )
    return jnp.where(moves, (about_origin[:, None, :] * axes[None]).sum(-1), 0.0)


@algorithm("q", "wrenches")
def generalized_forces(model: Model, q: jax.Array, wrenches: jax.Array) -> jax.Array:
    """Generalized forces (nv,) of wrenches on bodies, by virtual work: tau = sum_b J_b^T w_b.

    Args:
        model: the robot.
        q: (nq,) configuration.
        wrenches: (nb, 6) [moment N m; force N], world axes, at each body's frame origin.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> push = jnp.zeros((2, 6)).at[0, 3].set(1.0)
        >>> rb.dynamics.generalized_forces(model, model.default_state().q, push).shape
        (2,)
    """
    if not model.nv:
        return jnp.zeros(0, q.dtype)
    d = driver(model, q.dtype)
    joints = d.joints(q, None)
    tau = generalized(d, joints, on_links(d, joints, wrenches))
    return d.pack(tau, jnp.zeros(model.nv, q.dtype))
