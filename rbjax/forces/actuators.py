"""Actuators without a state: affine in control, length and speed.

    tau = moment^T f,   f = clip((g0 + g1 l + g2 l') clip(u) + b0 + b1 l + b2 l')
(MuJoCo, *Computation*, actuation model.) The numbers are the model's own: model.actuators.
"""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.jacobians import moment_arms
from rbjax.dynamics.kinematics import body_poses, link_poses
from rbjax.forces.element import Element, Loads
from rbjax.forces.instant import Instant, table
from rbjax.forces.transmissions import joint_reach
from rbjax.lanes import Lane, Vec3, add, inner, is_literal, is_zero, mul, total
from rbjax.model.links import lane, matrix_apply, matrix_product
from rbjax.rotations import quaternion
from rbjax.spatial import Force


class Actuators(Element):
    """The actuators of `model.actuators`, one a row, at joints and at sites."""

    @property
    def actuates(self) -> bool:
        return True

    def loads(self, now: Instant) -> Loads:
        model, dtype = now.model, now.v.dtype
        actuators = model.actuators
        gain, bias = table(actuators.gain, dtype), table(actuators.bias, dtype)
        ctrlrange = table(actuators.ctrlrange, dtype)
        forcerange = table(actuators.forcerange, dtype)
        out: dict[int, Lane] = {}
        at_sites = _site_moments(now)
        for i in range(model.nu):
            arms, length = _moment(now, i, at_sites)
            if not arms:
                continue
            speed = total(mul(arm, now.v[n]) for n, arm in arms.items())
            affine = (1.0, length, speed)
            strength = inner((lane(gain[:, k], i) for k in range(3)), affine)
            offset = inner((lane(bias[:, k], i) for k in range(3)), affine)
            force = add(mul(strength, clip(now.u[i], ctrlrange, i)), offset)
            force = clip(force, forcerange, i)
            for n, arm in arms.items():
                out[n] = add(out.get(n, 0.0), mul(arm, force))
        return Loads(out)


def clip(x: Lane, limits: Any, i: int) -> Lane:
    """x within row i of the limits (n, 2); untouched where these are known to be infinite."""
    low, high = lane(limits[:, 0], i), lane(limits[:, 1], i)
    if is_literal(low) and np.isneginf(low) and np.isposinf(high):
        return x
    return jnp.clip(x, jnp.asarray(low, x.dtype), jnp.asarray(high, x.dtype))


def _moment(now: Instant, i: int, at_sites: dict) -> tuple[dict[int, Lane], Lane]:
    """Row of the moment arms of actuator i as {velocity coordinate: arm}, and its length."""
    joint = now.model.actuators.joints[i]
    if i in at_sites:
        return {n: arm for n, arm in at_sites[i].items() if not is_zero(arm)}, 0.0
    if joint < 0:
        return {}, 0.0
    gear = table(now.model.actuators.gear, now.q.dtype)
    length, arms = joint_reach(now, joint, [lane(gear[:, k], i) for k in range(6)])
    return arms, length


def _site_moments(now: Instant) -> dict[int, dict[int, Lane]]:
    """Moment arms of each actuator whose gear is a wrench [force; torque] at a site."""
    model, q, d = now.model, now.q, now.links.driver
    top, actuators, sites = model.topology, model.actuators, model.sites
    driven = [i for i, site in enumerate(actuators.sites) if site >= 0]
    if d.listed or not driven:
        gear = table(actuators.gear, q.dtype)
        out = {}
        for i in driven:
            force, torque = (Vec3(*(lane(gear[:, k + n], i) for n in range(3))) for k in (0, 3))
            out[i] = now.site(actuators.sites[i]).arms(Force(torque, force))
        return out
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
    return {i: dict(enumerate(arms[k])) for k, i in enumerate(driven)}
