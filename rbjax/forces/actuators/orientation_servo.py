"""An orientation servo: three torques along the shortest rotation to a target attitude.

    tau = kp log(Q^-1 Q_target) + c - kv w,      in the axes of the moving frame
(MuJoCo, *XML reference*, actuator/orientation.) The target is a rotation vector or a quaternion. It
may be a state whose rate is the control.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.forces.actuators.activation import Activation, clip
from rbjax.forces.actuators.transmissions import relative_quaternion
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads
from rbjax.forces.reach import Arms, add_arms, arms_between
from rbjax.lanes import Lane, Vec3, add, is_zero, mul, safe_sqrt, total
from rbjax.model.leaves import numbers, table
from rbjax.rotations import quaternion


class OrientationServo(Element):
    """A servo on the orientation of a ball joint, or of a site relative to another.

    gains: (3,) kp, c, kv.
    ctrlrange: (n, 2) range of each control.
    strongest: () largest torque.
    activation: activation of a target that is a state; None otherwise.
    controls: indices of three (rotation vector) or four (quaternion) controls; static.
    joint: index of the ball joint, or -1 for a site; static.
    site, reference: indices of the site and of the site relative to which it is measured; static.
    early: whether the torque uses the activation after the step; static.
    """

    gains: jax.Array
    ctrlrange: jax.Array
    strongest: jax.Array
    activation: Activation | None
    controls: tuple[int, ...] = eqx.field(static=True)
    joint: int = eqx.field(static=True, default=-1)
    site: int = eqx.field(static=True, default=-1)
    reference: int = eqx.field(static=True, default=-1)
    early: bool = eqx.field(static=True, default=False)

    @property
    def size(self) -> int:
        return 0 if self.activation is None else 3

    @property
    def actuates(self) -> bool:
        return True

    def loads(self, context: Context) -> Loads:
        current, rows = self._turned(context)
        inverse = [current[0], *(-x for x in current[1:])]
        error = quaternion.log_lanes(quaternion.product(inverse, self._target(context)))
        kp, constant, kv = numbers(self.gains, context.q.dtype)
        torque = []
        for row, e in zip(rows, error, strict=True):
            speed = total(mul(arm, context.v[n]) for n, arm in row.items())
            torque.append(add(add(mul(kp, e), constant), -mul(kv, speed)))
        size = safe_sqrt(sum(x * x for x in torque))
        limit = numbers(self.strongest[None], context.q.dtype)[0]
        strong = size > limit
        share = jnp.where(strong, limit, 1.0) / jnp.where(strong, size, 1.0)
        tau: Arms = {}
        for row, x in zip(rows, torque, strict=True):
            tau = add_arms(tau, {n: mul(arm, share * x) for n, arm in row.items()})
        return Loads(tau)

    def rate(self, context: Context) -> Sequence[Lane]:
        if self.activation is None or context.ctrl is None:
            return [0.0] * self.size
        u = zip(self._inputs(context), context.x, strict=True)
        return [self.activation.rate(u, a) for u, a in u]

    def advance(self, context: Context, dt: Any) -> Sequence[Lane]:
        if self.activation is None or context.ctrl is None:
            return context.x
        return self._nearest(self._next(context, dt))

    def within(self, x: jax.Array) -> Sequence[Lane]:
        if self.activation is None:
            return list(x)
        return self._nearest([self.activation.within(a) for a in x])

    def _nearest(self, phi: list[Lane]) -> list[Lane]:
        """Compute the rotation vector of the same orientation whose angle is at most pi."""
        angle = safe_sqrt(sum(x * x for x in phi))
        far = angle > jnp.pi
        turns = 2 * jnp.pi * jnp.round(angle / (2 * jnp.pi))
        share = jnp.where(far, 1 - turns / jnp.where(far, angle, 1.0), 1.0)
        return [x * share for x in phi]

    def _next(self, context: Context, dt: Any) -> list[Lane]:
        assert self.activation is not None
        u = zip(self._inputs(context), context.x, strict=True)
        return [self.activation.advanced(u, a, dt) for u, a in u]

    def _inputs(self, context: Context) -> list[Lane]:
        limits = table(self.ctrlrange, context.q.dtype)
        return [clip(context.ctrl[k], limits, i) for i, k in enumerate(self.controls)]

    def _target(self, context: Context) -> list[Lane]:
        """Compute the quaternion of the target, not normalized."""
        if self.activation is None:
            u = self._inputs(context)
            if len(u) == 3:
                return quaternion.exp_lanes(u)
            none = total(x * x for x in u) < 1e-30
            return [jnp.where(none, 1.0 if k == 0 else 0.0, x) for k, x in enumerate(u)]
        phi = self._next(context, context.h) if self.early else list(context.x)
        return quaternion.exp_lanes(phi)

    def _turned(self, context: Context) -> tuple[list[Lane], list[Arms]]:
        """Compute the orientation of the servo's frame as a quaternion, and three rows of moment
        arms. Row k has the moment arms of a unit torque about axis k of the frame."""
        if self.joint >= 0:
            top = context.model.topology
            at, start = top.joint_v[self.joint], top.joint_q[self.joint]
            return [context.q[start + k] for k in range(4)], [{at + k: 1.0} for k in range(3)]
        site, base = context.site(self.site), context.site(self.reference)
        axes = site.rotation.columns
        rows = [arms_between(context, site, base, Vec3.zero(), axis) for axis in axes]
        rows = [{n: arm for n, arm in row.items() if not is_zero(arm)} for row in rows]
        return relative_quaternion(site, base, context.q.dtype), rows
