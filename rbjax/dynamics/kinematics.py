"""Forward kinematics: where links, bodies and sites are, and how bodies move.

    R_WC = R_WP R_PC,   p_WC = p_WP + R_WP p_PC,   w_C = w_P + z qd,   v_C = v_P + w_P x r + z qd
(Featherstone, 4.4; Lynch & Park, *Modern Robotics*, ch. 4-5.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.drivers import Driver, driver
from rbjax.lanes import Mat3, Vec3
from rbjax.model import WORLD, Model
from rbjax.model.links import lane, matrix_apply, matrix_product
from rbjax.rotations import quaternion
from rbjax.spatial import Motion, Transform


class Poses(NamedTuple):
    """Attitude R (nb, 3, 3), body to world axes, and position p (nb, 3) of each body's frame."""

    R: jax.Array
    p: jax.Array


def world_poses(d: Driver, joints: Any) -> Any:
    """The pose of each link in the world, per link."""

    def step(x, parent):
        link, joint = x
        pose = parent.then(joint.transform(link))
        return pose, pose

    root = Transform(Mat3.identity(), Vec3.zero())
    return d.outward(step, root, d.zip(d.constants, joints))


def link_poses(d: Driver, q: jax.Array) -> tuple[jax.Array, jax.Array]:
    """World poses of the links as arrays R (nv, 3, 3) and p (nv, 3)."""
    columns = d.columns(world_poses(d, d.joints(q, None)), jnp.zeros(d.topology.nv, q.dtype))
    return jnp.stack(list(columns.R), -1).reshape(-1, 3, 3), jnp.stack(list(columns.p), -1)


def body_poses(d: Driver, R: jax.Array, p: jax.Array) -> Poses:
    """World poses of the bodies, from those of the links that carry them."""
    body_R = jnp.asarray(d.prepared.body_R, R.dtype)
    body_p = jnp.asarray(d.prepared.body_p, R.dtype)
    link = np.array(d.topology.body_links, int)
    fixed = (link == WORLD)[:, None]
    carrier_R = jnp.where(fixed[..., None], jnp.eye(3, dtype=R.dtype), R[link])
    carrier_p = jnp.where(fixed, jnp.zeros(3, R.dtype), p[link])
    return Poses(matrix_product(carrier_R, body_R), carrier_p + matrix_apply(carrier_R, body_p))


def body_transforms(d: Driver, poses: Any) -> Any:
    """The pose of each body, from those of the links in the form of `Driver.whole`."""
    top, R, p = d.topology, d.prepared.body_R, d.prepared.body_p
    if d.listed:
        welds = [
            Transform(
                Mat3(*(lane(R[:, i, j], b) for i in range(3) for j in range(3))),
                Vec3(*(lane(p[:, i], b) for i in range(3))),
            )
            for b in range(top.nb)
        ]
        root = Transform(Mat3.identity(), Vec3.zero())
        carriers = [root if k == WORLD else poses[k] for k in top.body_links]
        return d.each(Transform.then, carriers, welds)
    fixed = np.array(top.body_links) == WORLD
    carrier = d.take(poses, [max(k, 0) for k in top.body_links])
    if fixed.any():
        own = list(zip(carrier.R, Mat3.identity(), strict=True))
        carrier = Transform(
            Mat3(*(jnp.where(fixed, one, x) for x, one in own)),
            Vec3(*(jnp.where(fixed, 0.0, x) for x in carrier.p)),
        )
    R, p = jnp.asarray(R, carrier.p[0].dtype), jnp.asarray(p, carrier.p[0].dtype)
    weld = Transform(Mat3(*(R[:, i, j] for i in range(3) for j in range(3))), Vec3(*p.T))
    return d.each(Transform.then, carrier, weld)


@algorithm("q")
def forward_kinematics(model: Model, q: jax.Array) -> Poses:
    """Poses of all bodies in the world.

    R_WC = R_WP R_PC, p_WC = p_WP + R_WP p_PC.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        `Poses(R (nb, 3, 3), p (nb, 3))` in metres, in the file's order without the world.

    Raises:
        InputError: wrong shape or dtype, values that are not finite, zero quaternions.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, 4.4.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> poses = rb.forward_kinematics(model, model.default_state().q)
        >>> poses.p.shape
        (2, 3)
    """
    d = driver(model, q.dtype)
    if not model.nv:
        return body_poses(d, jnp.zeros((1, 3, 3), q.dtype), jnp.zeros((1, 3), q.dtype))
    poses = body_transforms(d, d.whole(world_poses(d, d.joints(q, None))))
    R, p = d.stack(poses, lambda pose: pose.R, q), d.stack(poses, lambda pose: pose.p, q)
    return Poses(R.reshape(-1, 3, 3), p)


@algorithm("q")
def site_pose(model: Model, q: jax.Array, site: str) -> tuple[jax.Array, jax.Array]:
    """Pose of a named site in the world: R (3, 3), p (3,).

    Args:
        model: the robot.
        q: (nq,) configuration.
        site: its name in the file.

    Raises:
        UnknownName: with the names there are.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("arm7")
        >>> R, p = rb.site_pose(model, model.default_state().q, "tool")
        >>> p.shape
        (3,)
    """
    i = model.site(site)
    poses = forward_kinematics(model, q)
    body = model.topology.site_bodies[i]
    R = quaternion.to_matrix(model.sites.orientation[i]).astype(q.dtype)
    p = model.sites.position[i].astype(q.dtype)
    if body == WORLD:
        return R, p
    return matrix_product(poses.R[body], R), poses.p[body] + matrix_apply(poses.R[body], p)


def link_twists(d: Driver, joints: Any) -> Any:
    """Each link's pose in its parent's, and its twist in its own axes at its own origin."""

    def step(x, V_parent):
        link, joint = x
        X = joint.transform(link)
        V = X(V_parent) + Motion(joint.rate, (joint.S * joint.qd).lin)
        return V, V

    return d.outward(step, Motion.zero(), d.zip(d.constants, joints))


def link_motions(d: Driver, joints: Any) -> Any:
    """Each link's pose in the world, and its twist in its own axes at its own origin."""

    def step(x, parent):
        link, joint = x
        pose, V = parent
        X = joint.transform(link)
        V = X(V) + Motion(joint.rate, (joint.S * joint.qd).lin)
        here = pose.then(X), V
        return here, here

    root = Transform(Mat3.identity(), Vec3.zero()), Motion.zero()
    return d.outward(step, root, d.zip(d.constants, joints))


@algorithm("q", "v")
def body_velocities(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Twists of all bodies (nb, 6): [angular; linear] in world axes, at each body's frame origin.

    V_b = J_b(q) v.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Returns:
        (nb, 6), rad/s and m/s.

    Source: Featherstone, 4.4.

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("cart_pole")
        >>> state = model.random_state(jax.random.key(0))
        >>> rb.body_velocities(model, state.q, state.v).shape
        (2, 6)
    """
    d = driver(model, q.dtype)
    if not model.nv:
        return jnp.zeros((model.nb, 6), q.dtype)
    poses, twists = d.unzip(link_motions(d, d.joints(q, v)), 2)
    poses, twists = d.whole(poses), d.whole(twists)
    link = [max(k, 0) for k in model.topology.body_links]
    moves = d.known([0.0 if k == WORLD else 1.0 for k in model.topology.body_links])

    def in_world(body, link, V, moves):
        ang = (link.R @ V.ang) * moves
        return Motion(ang, (link.R @ V.lin) * moves + ang.cross(body.p - link.p))

    carriers = d.take(poses, link), d.take(twists, link)
    return d.stack(d.each(in_world, body_transforms(d, poses), *carriers, moves), lambda V: V, q)
