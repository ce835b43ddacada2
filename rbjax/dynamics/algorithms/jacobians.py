"""Geometric Jacobians, their rates, and the generalized forces of wrenches on bodies.

    V = J(q) v;  column i is [z_i; z_i x (p - p_i)] for a hinge and [0; z_i] for a slide,
    tau = sum over bodies of J_b^T w_b                                       (virtual work)
Angular first, world axes, at a point of the body (Lynch & Park, *Modern Robotics*, 5.1).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.algorithms.frames import carried_point
from rbjax.dynamics.algorithms.kinematics import POSE, TWIST, sweep
from rbjax.dynamics.algorithms.link_forces import generalized, on_links
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.model import WORLD, Model, Topology
from rbjax.spatial import Motion


def ancestor_mask(top: Topology, link: int) -> np.ndarray:
    """(nv,) whether each link moves the given one."""
    mask = np.zeros(top.nv, bool)
    if link != WORLD:
        mask[list(top.ancestors[link])] = True
    return mask


@algorithm("q", "point")
def jacobian(
    model: Model,
    q: jax.Array,
    body: str | None = None,
    point: jax.Array | None = None,
    *,
    site: str | None = None,
) -> jax.Array:
    """Jacobian (6, nv) of a point of a body or site: [angular; linear] in world axes, V = J v.

    Args:
        model: the robot.
        q: (nq,) configuration.
        body: the name of a body; "world" is the frame that does not move.
        point: (3,) m in the frame of the body or site; its origin if None.
        site: the name of a site, instead of a body.

    Returns:
        (6, nv); zero where a coordinate does not move the point.

    Raises:
        UnknownName: no such body or site. InputError: both or neither given; a wrong shape.

    Source: Lynch & Park, *Modern Robotics*, 5.1 (there at the world's origin).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rb.jacobian(model, model.default_state().q, "lower").shape
        (6, 2)
    """
    d = driver(model, q.dtype)
    link, r = carried_point("jacobian", model, d, q, body, site, point)
    if link == WORLD:
        return jnp.zeros((6, model.nv), q.dtype)
    joints = d.joints(q, None)
    poses = d.whole(*sweep(d, joints, POSE))
    here = d.each(lambda pose: pose.p + pose.R @ r, d.take(poses, [link]))

    def column(pose, at, S, moves):
        S = S * moves
        spin = pose.R @ S.ang
        return Motion(spin, spin.cross(at - pose.p) + pose.R @ S.lin)

    points = d.take(here, [0] * model.nv)
    columns = d.each(column, poses, points, d.whole_axes(joints), _moves(d, link))
    return d.stack(columns, lambda m: m, q).T


@algorithm("q", "v", "point")
def jacobian_rate(
    model: Model,
    q: jax.Array,
    v: jax.Array,
    body: str | None = None,
    point: jax.Array | None = None,
    *,
    site: str | None = None,
) -> jax.Array:
    """J'(q, v) (6, nv), the rate of `jacobian` while the robot moves at v.

    With u the velocity of a link's origin and w the angular velocity of its axis z,
    z' = w x z and (z x r)' = z' x r + z x (u_point - u). `frame_bias_acceleration` is J' v.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        body: the name of a body; "world" is the frame that does not move.
        point: (3,) m in the frame of the body or site; its origin if None.
        site: the name of a site, instead of a body.

    Returns:
        (6, nv) [angular; linear] in world axes.

    Raises:
        UnknownName: no such body or site. InputError: both or neither given; a wrong shape.

    Source: Featherstone, 2.10 (the derivative of `jacobian`, written out).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> state = model.default_state()
        >>> rb.jacobian_rate(model, state.q, state.v, "lower").shape
        (6, 2)
    """
    d = driver(model, q.dtype)
    link, r = carried_point("jacobian_rate", model, d, q, body, site, point)
    if link == WORLD:
        return jnp.zeros((6, model.nv), q.dtype)

    def in_world(pose, V):
        return pose, Motion(pose.R @ V.ang, pose.R @ V.lin)

    def moving(x):
        pose, V = x
        arm = pose.R @ r
        return pose.p + arm, V.lin + V.ang.cross(arm)

    joints = d.joints(q, v)
    links = d.each(in_world, *map(d.whole, sweep(d, joints, POSE, TWIST)))
    here = d.each(moving, d.take(links, [link]))
    carriers = d.take(links, [x.node[-1] for x in d.topology.dofs])

    def column(x, carrier, point, moves, S, S_rate=None):
        (pose, V), (_, T), (at, speed) = x, carrier, point
        if S_rate is None:  # both parts of S are along z
            axis = pose.R.columns[2] * moves
            rate = T.ang.cross(axis)
            z, spin, slip = axis * S.ang[2], rate * S.ang[2], rate * S.lin[2]
        else:
            z, slid = pose.R @ (S.ang * moves), pose.R @ (S.lin * moves)
            spin = T.ang.cross(z) + pose.R @ (S_rate.ang * moves)
            slip = T.ang.cross(slid) + pose.R @ (S_rate.lin * moves)
        return Motion(spin, spin.cross(at - pose.p) + z.cross(speed - V.lin) + slip)

    points, S = d.take(here, [0] * model.nv), [d.whole_axes(joints)]
    if not d.topology.constant_axes:
        S.append(d.whole(d.axes(joints)[1]))
    columns = d.each(column, links, carriers, points, _moves(d, link), *S)
    return d.stack(columns, lambda m: m, q).T


def _moves(d: Driver, link: int) -> Any:
    """1 for each link that moves the given one, else 0."""
    return d.literals([1.0 if x else 0.0 for x in ancestor_mask(d.topology, link)])


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
