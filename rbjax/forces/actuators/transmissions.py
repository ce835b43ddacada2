"""Transmissions: maps from joint coordinates to an actuator's length and moment arms.

    l = l(q),      l' = sum of r_n v_n,      tau_n = r_n f
l is the length and r_n is the moment arm of dof n (MuJoCo, *Computation*, transmission). r is the
gradient of l if l is a length in space. If a site is measured in the axes of another site, r is the
effect of a force on one site and its reaction on the other, as in MuJoCo. Joints that carry both
sites have no moment arm.
"""

from __future__ import annotations

import abc

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.context import Context, FrameState
from rbjax.forces.reach import Reach, arms_between, flexible_dofs, opposed_arms
from rbjax.forces.tendons.paths import tendon_reach
from rbjax.lanes import Lane, Vec3, add, inner, is_zero, mul, quaternion_matrix, sub
from rbjax.model.leaves import numbers, scalar
from rbjax.model.record import Record
from rbjax.rotations import quaternion
from rbjax.spatial import Force


class Transmission(Record):
    """Base class of a map from a configuration to a length and moment arms."""

    @abc.abstractmethod
    def reach(self, context: Context) -> Reach:
        """Compute the length and the moment arms at an instant."""

    def turn(self, dtype: jax.typing.DTypeLike) -> Lane:
        """Compute the change of the length over a full turn, if the length is an angle."""
        raise TypeError(f"the length of {type(self).__name__} is not an angle")


class JointAxis(Transmission):
    """The transmission to a joint, or to an axis of a joint.

    gear: (6,) factors; [axis, ...] for a ball, [force axis in the world; torque axis] for a free
        joint.
    in_parent: whether the torque axis is in the parent's axes; static.
    """

    gear: jax.Array
    joint: int = eqx.field(static=True)
    in_parent: bool = eqx.field(static=True, default=False)

    def reach(self, context: Context) -> Reach:
        return joint_reach(context, self.joint, numbers(self.gear, context.q.dtype), self.in_parent)

    def turn(self, dtype: jax.typing.DTypeLike) -> Lane:
        return 2 * jnp.pi * Vec3(*numbers(self.gear, dtype)[:3]).norm()


class SiteWrench(Transmission):
    """A wrench at a site in its axes, gear (6,) = [force; torque]. The length is zero."""

    gear: jax.Array
    site: int = eqx.field(static=True)

    def reach(self, context: Context) -> Reach:
        force, torque = split_gear(numbers(self.gear, context.q.dtype))
        return Reach(0.0, context.site(self.site).arms(Force(torque, force)))


class SitePose(Transmission):
    """The pose of a site in the axes of another: l = gear . [position; rotation vector]."""

    gear: jax.Array
    site: int = eqx.field(static=True)
    reference: int = eqx.field(static=True)

    def reach(self, context: Context) -> Reach:
        site, base = context.site(self.site), context.site(self.reference)
        force, torque = split_gear(numbers(self.gear, context.q.dtype))
        length: Lane = 0.0
        if not all(map(is_zero, force)):
            length = force.dot(base.rotation.T @ (site.position - base.position))
        if not all(map(is_zero, torque)):
            turned = quaternion.log_lanes(relative_quaternion(site, base, context.q.dtype))
            length = add(length, torque.dot(Vec3(*turned)))
        force, torque = base.rotation @ force, base.rotation @ torque
        return Reach(length, arms_between(context, site, base, force, torque))

    def turn(self, dtype: jax.typing.DTypeLike) -> Lane:
        return 2 * jnp.pi * Vec3(*numbers(self.gear, dtype)[3:]).norm()


class SliderCrank(Transmission):
    """The position of a slider on the z axis of its site, connected by a rod of constant length to
    the site of the crank. If the crank is too far away for the rod, the position is the foot of the
    perpendicular from it."""

    gear: jax.Array
    rod: jax.Array
    crank: int = eqx.field(static=True)
    slider: int = eqx.field(static=True)

    def reach(self, context: Context) -> Reach:
        dtype = context.q.dtype
        crank, slider = context.site(self.crank), context.site(self.slider)
        rod = scalar(self.rod, dtype)
        axis, r = slider.rotation.columns[2], crank.position - slider.position
        along = axis.dot(r)
        square = jnp.asarray(add(sub(mul(along, along), r.dot(r)), mul(rod, rod)), dtype)
        near = square > 0
        root = jnp.sqrt(jnp.where(near, square, 1.0))
        # d length = by_r . dr + by_axis . d axis
        share = jnp.where(near, 1 - along / root, 1.0)
        by_r = axis * share + r * jnp.where(near, 1 / root, 0.0)
        by_axis = r * share
        length = sub(along, jnp.where(near, root, 0.0))
        pulled = slider.world_arms(-by_r, axis.cross(by_axis))
        both = flexible_dofs(context.model.topology, crank, slider)
        arms = opposed_arms(crank.world_arms(by_r, Vec3.zero()), pulled, both)
        return Reach(length, arms).scaled(numbers(self.gear, dtype)[0])


class TendonLength(Transmission):
    """The length of a tendon: l = gear times the length of `model.tendons`."""

    gear: jax.Array
    tendon: int = eqx.field(static=True)

    def reach(self, context: Context) -> Reach:
        return tendon_reach(context, self.tendon).scaled(numbers(self.gear, context.q.dtype)[0])


def joint_reach(context: Context, joint: int, gear: list[Lane], in_parent: bool = False) -> Reach:
    """Compute the length and moment arms of a gear (6 lanes) on a joint."""
    top, q = context.model.topology, context.q
    kind, at, start = top.joint_kinds[joint], top.joint_v[joint], top.joint_q[joint]
    if not top.joints[joint].quaternion:
        arms = gear[: top.joints[joint].nv]
        length = inner(arms, [q[start + k] for k in range(len(arms))])
        return Reach(length, {at + k: arm for k, arm in enumerate(arms)})
    turn = start + (3 if kind == "free" else 0)
    turned = [q[turn + k] for k in range(4)]
    axis = Vec3(*(gear[3:] if kind == "free" else gear[:3]))
    own = quaternion_matrix(*turned).T @ axis if in_parent else axis
    if kind == "ball":
        length = inner(axis, quaternion.log_lanes(turned))  # the rotation keeps its own axis
        return Reach(length, {at + k: own[k] for k in range(3)})
    return Reach(0.0, {at + k: x for k, x in enumerate([*gear[:3], *own])})


def relative_quaternion(
    site: FrameState, base: FrameState, dtype: jax.typing.DTypeLike
) -> list[Lane]:
    """Compute the quaternion of a frame's attitude in the axes of another, not normalized."""
    R = base.rotation.T @ site.rotation
    return quaternion.from_matrix_lanes([jnp.asarray(x, dtype) for x in R])


def split_gear(gear: list[Lane]) -> tuple[Vec3, Vec3]:
    """Split a gear (6 lanes) into a force and a torque."""
    return Vec3(*gear[:3]), Vec3(*gear[3:])
