"""Forward kinematics: poses of links and bodies, and twists of bodies.

    R_WC = R_WP R_PC,   p_WC = p_WP + R_WP p_PC,   w_C = w_P + z qd,   v_C = v_P + w_P x r + z qd
(Featherstone, 4.4; Lynch & Park, *Modern Robotics*, ch. 4-5.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.lanes import Mat3, Vec3
from rbjax.model import WORLD, Model
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


def body_transforms(d: Driver, poses: Any) -> Any:
    """The pose of each body, from the poses of the links in the form of `Driver.whole`."""
    top = d.topology
    if d.listed:
        welds = [d.prepared.weld(b) for b in range(top.nb)]
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
    weld = jax.tree.map(lambda x: jnp.asarray(x, carrier.p[0].dtype), d.prepared.welds)
    return d.each(Transform.then, carrier, weld)


@algorithm("q")
def forward_kinematics(model: Model, q: jax.Array) -> Poses:
    """Poses of all bodies in the world.

    R_WC = R_WP R_PC, p_WC = p_WP + R_WP p_PC.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        `Poses(R (nb, 3, 3), p (nb, 3))` in metres, in the order of the file, without the world.

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
        made = d.prepared
        return Poses(jnp.asarray(made.body_R, q.dtype), jnp.asarray(made.body_p, q.dtype))
    poses = body_transforms(d, d.whole(world_poses(d, d.joints(q, None))))
    R, p = d.stack(poses, lambda pose: pose.R, q), d.stack(poses, lambda pose: pose.p, q)
    return Poses(R.reshape(-1, 3, 3), p)


def link_twists(d: Driver, joints: Any) -> Any:
    """Each link's twist in its own axes at its own origin."""

    def step(x, V_parent):
        link, joint = x
        V = joint.transform(link)(V_parent) + joint.twist
        return V, V

    return d.outward(step, Motion.zero(), d.zip(d.constants, joints))


def link_motions(d: Driver, joints: Any) -> Any:
    """Each link's pose in the world, and its twist in its own axes at its own origin."""

    def step(x, parent):
        link, joint = x
        pose, V = parent
        X = joint.transform(link)
        V = X(V) + joint.twist
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
