"""Forces that the model itself applies: joint springs, dampers, actuators.

    tau = -K (q - q_rest) - D v + sum over actuators of moment^T f
    f = clip((g0 + g1 l + g2 l') clip(u) + b0 + b1 l + b2 l')
K acts on the tangent of the configuration (MuJoCo, *Computation*: passive and actuation forces).
`applied_forces` is all that `simulate` and `rollout` feed to `forward_dynamics`.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.drivers import Driver, Listed, driver
from rbjax.dynamics.jacobians import moment_arms
from rbjax.dynamics.kinematics import body_poses, link_poses
from rbjax.dynamics.manifold import difference, difference_lanes
from rbjax.dynamics.packing import pack
from rbjax.lanes import (
    Lane,
    Mat3,
    Vec3,
    add,
    inner,
    is_literal,
    is_zero,
    mul,
    neg,
    quaternion_matrix,
    total,
)
from rbjax.model import JOINT_SIZES, WORLD, Model, State
from rbjax.model.links import lane, matrix_apply, matrix_product
from rbjax.rotations import quaternion
from rbjax.spatial import Force, Transform


def _table(x: jax.Array, dtype):
    """Numbers as numpy where they are known while tracing, so that zeros cost nothing."""
    if isinstance(x, jax.core.Tracer):
        return x.astype(dtype)
    return np.asarray(x, np.float64) if isinstance(x, (jax.Array, np.ndarray)) else x


def _clip(x: Lane, limits, i: int) -> Lane:
    low, high = lane(limits[:, 0], i), lane(limits[:, 1], i)
    if is_literal(low) and np.isneginf(low) and np.isposinf(high):
        return x
    return jnp.clip(x, jnp.asarray(low, x.dtype), jnp.asarray(high, x.dtype))


def passive_lanes(model: Model, q: jax.Array, v: jax.Array) -> list[Lane]:
    """Springs and dampers, one lane per velocity coordinate."""
    top, dtype = model.topology, v[0].dtype
    joints = model.joints
    stiffness, damping = _table(joints.stiffness, dtype), _table(joints.damping, dtype)
    out: list[Lane] = [neg(mul(lane(damping, i), v[i])) for i in range(model.nv)]
    if isinstance(stiffness, np.ndarray) and not stiffness.any():
        return out
    rest = _table(joints.springref, dtype)
    at_rest = [lane(rest, i) for i in range(top.nq)]
    stretch = difference_lanes(top, at_rest, [q[i] for i in range(top.nq)])
    for j, (kind, at) in enumerate(zip(top.joint_kinds, top.joint_v, strict=True)):
        k = lane(stiffness, j)
        if not is_zero(k):
            for i in range(at, at + JOINT_SIZES[kind][1]):
                out[i] = add(out[i], neg(mul(k, stretch[i])))
    return out


def site_moments(model: Model, q: Any, v: Any, d: Any = None) -> dict[int, Any]:
    """Moment arms (nv,) of each actuator whose gear is a wrench [force; torque] at a site."""
    top, actuators, sites = model.topology, model.actuators, model.sites
    driven = [i for i, site in enumerate(actuators.sites) if site >= 0]
    if not driven:
        return {}
    d = d or driver(model, q.dtype)
    if isinstance(d, Listed):
        links = list(zip(d.whole(d.joints(q, v)), d.whole(d.constants), strict=True))
        return {i: _carried(model, d, links, i, v[0].dtype) for i in driven}
    R, p = link_poses(d, q)
    poses = body_poses(d, R, p)
    at = [actuators.sites[i] for i in driven]
    bodies = [top.site_bodies[s] for s in at]
    index = np.array(bodies)
    site_R = quaternion.to_matrix(sites.orientation[np.array(at)]).astype(q.dtype)
    site_R = matrix_product(poses.R[index], site_R)
    site_p = matrix_apply(poses.R[index], sites.position[np.array(at)].astype(q.dtype))
    gear = actuators.gear[np.array(driven)].astype(q.dtype)
    force, torque = matrix_apply(site_R, gear[:, :3]), matrix_apply(site_R, gear[:, 3:])
    wrenches = jnp.concatenate([torque, force], -1)
    arms = moment_arms(top, R, p, bodies, poses.p[index] + site_p, wrenches)
    return {i: arms[k] for k, i in enumerate(driven)}


def _carried(model: Model, d: Driver, links: list, i: int, dtype: Any) -> list[Lane]:
    """The same of one actuator, its wrench carried from link to link down to the base."""
    top, sites = model.topology, model.sites
    site = model.actuators.sites[i]
    body = top.site_bodies[site]
    if body == WORLD:
        return [0.0] * top.nv
    position, orientation = (_table(x, dtype) for x in (sites.position, sites.orientation))
    gear, body_R, body_p = model.actuators.gear, d.prepared.body_R, d.prepared.body_p
    gear = _table(gear, dtype)
    force, torque = (Vec3(*(lane(gear[:, k + n], i) for n in range(3))) for k in (0, 3))
    placed = Transform(
        quaternion_matrix(*(lane(orientation[:, k], site) for k in range(4))),
        Vec3(*(lane(position[:, k], site) for k in range(3))),
    )
    weld = Transform(
        Mat3(*(lane(body_R[:, j, k], body) for j in range(3) for k in range(3))),
        Vec3(*(lane(body_p[:, k], body) for k in range(3))),
    )
    wrench, arms = weld.T(placed.T(Force(torque, force))), [0.0] * top.nv
    at = top.body_links[body]
    while at != WORLD:
        joint, constants = links[at]
        arms[at] = joint.S.dot(wrench)
        wrench = joint.transform(constants).T(wrench)
        at = top.links[at].parent
    return arms


def _moment(model: Model, q, i: int, at_sites: dict) -> tuple[dict[int, Lane], Lane]:
    """Row of the moment arms of actuator i as {velocity coordinate: arm}, and its length."""
    top, joint = model.topology, model.actuators.joints[i]
    if i in at_sites:
        return {n: at_sites[i][n] for n in range(model.nv) if not is_zero(at_sites[i][n])}, 0.0
    if joint < 0:
        return {}, 0.0
    gear = _table(model.actuators.gear, q[0].dtype)
    g = [lane(gear[:, k], i) for k in range(6)]
    kind, at, start = top.joint_kinds[joint], top.joint_v[joint], top.joint_q[joint]
    nv = JOINT_SIZES[kind][1]
    arms = {at + k: g[k] for k in range(nv)}
    if kind in ("hinge", "slide"):
        return arms, mul(g[0], q[start])
    if kind == "ball":
        return arms, inner(g[:3], quaternion.log_lanes([q[start + k] for k in range(4)]))
    return arms, 0.0


def actuator_lanes(model: Model, q: Any, v: Any, ctrl: Any, d: Any = None) -> list[Lane]:
    """Actuator forces on the velocity coordinates, limits of joints included."""
    top, actuators, dtype = model.topology, model.actuators, v[0].dtype
    gain, bias = _table(actuators.gain, dtype), _table(actuators.bias, dtype)
    ctrlrange = _table(actuators.ctrlrange, dtype)
    forcerange = _table(actuators.forcerange, dtype)
    out: list[Lane] = [0.0] * model.nv
    at_sites = site_moments(model, q, v, d)
    for i in range(model.nu):
        arms, length = _moment(model, q, i, at_sites)
        if not arms:
            continue
        speed = total(mul(arm, v[n]) for n, arm in arms.items())
        affine = (1.0, length, speed)
        strength = inner((lane(gain[:, k], i) for k in range(3)), affine)
        offset = inner((lane(bias[:, k], i) for k in range(3)), affine)
        force = add(mul(strength, _clip(ctrl[i], ctrlrange, i)), offset)
        force = _clip(force, forcerange, i)
        for n, arm in arms.items():
            out[n] = add(out[n], mul(arm, force))
    limits = _table(model.joints.forcerange, dtype)
    for j, (kind, at) in enumerate(zip(top.joint_kinds, top.joint_v, strict=True)):
        if kind in ("hinge", "slide") and not is_zero(out[at]):
            out[at] = _clip(out[at], limits, j)
    return out


def applied_lanes(model: Model, q, v, ctrl, d: Any = None) -> list[Lane]:
    """`applied_forces` on arrays or lists of lanes; d is the driver where the model has none."""
    lanes = passive_lanes(model, q, v)
    if ctrl is not None:
        driven = actuator_lanes(model, q, v, ctrl, d)
        lanes = [add(a, b) for a, b in zip(lanes, driven, strict=True)]
    return lanes


def applied(model: Model, q: jax.Array, v: jax.Array, ctrl: jax.Array | None) -> jax.Array:
    """`applied_forces` on checked arrays."""
    return pack(applied_lanes(model, q, v, ctrl) if model.nv else [], v)


@algorithm("state", "ctrl")
def applied_forces(model: Model, state: State, ctrl: jax.Array | None = None) -> jax.Array:
    """Generalized forces (nv,) of the model's own springs, dampers and actuators.

    tau = -K (q - q_rest) - D v + sum of moment^T f(u, l, l').

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))`.
        ctrl: (nu,) controls, clipped to their ranges; None for no actuation at all.

    Returns:
        (nv,) N m or N, to be given to `forward_dynamics` as tau.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite.

    Source: MuJoCo documentation, *Computation*, passive and actuation forces.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> rb.applied_forces(model, model.default_state(), jnp.ones(1)).shape
        (2,)
    """
    return applied(model, state.q, state.v, ctrl)


@algorithm("q")
def elastic_energy(model: Model, q: jax.Array) -> jax.Array:
    """Energy of the joint springs, sum of k |q - q_rest|^2 / 2, in joules.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> float(rb.forces.elastic_energy(model, model.default_state().q))
        0.0
    """
    top = model.topology
    stretch = difference(model, model.joints.springref.astype(q.dtype), q)
    joint_of = np.repeat(
        np.arange(len(top.joint_kinds)), [JOINT_SIZES[k][1] for k in top.joint_kinds]
    )
    return (model.joints.stiffness.astype(q.dtype)[joint_of] * stretch * stretch).sum() / 2
