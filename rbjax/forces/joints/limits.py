"""Compliant unilateral stops at the joint limits.

With p the penetration of a joint into its stop (beyond the limit less the margin), c = d r(p):

    f = k s(p) + c p'                      for p' >= 0 (loading),
    f = (k s(p))^2 / (k s(p) - c p')       for p' < 0 (unloading),

    s(p) = p^2 / (2 w),  r(p) = (p/w)^2 (3 - 2 p/w)   for 0 <= p <= w
    s(p) = p - w/2,      r(p) = 1                     beyond

While loading, the stop is a spring k and a damper d that set in over the width w. While unloading,
the damper fades so that the force stays positive, as in the law of Hunt and Crossley. The two forms
have the same slope at p' = 0, and the force has slope 0 at p = 0: f is once continuously
differentiable. The damping force f - k s(p) has the sign of p', so no energy is gained:

    dE/dt = -(f - k s) p' <= 0,      E = ... + k S(p),  S' = s

At rest under a load F the penetration is p = F / k + w / 2 (F > k w / 2). The coordinate of a ball
joint is its rotation angle, with one limit; its stop acts about the axis of the rotation.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.joint_state import JointState
from rbjax.lanes import Lane, add, inner, is_literal, is_zero, mul, neg, safe_sqrt, sub, total
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.rotations import quaternion
from rbjax.rotations.coefficients import where


class JointLimits(Element):
    """Compliant stops that keep hinges, slides and balls within `model.joints.range`.

    f = k s(p) + d r(p) p' for growing penetration p; the force is never negative.

    Fields, one entry per joint:
        stiffness: k (n,) N m/rad or N/m.
        damping: d (n,) N m s/rad or N s/m.
        margin: (n,) rad or m, distance before the limit at which the stop begins.
        width: w (n,) rad or m, positive, over which the stiffness sets in.
        joints: names or indices; static.

    Source: Hunt & Crossley, *Coefficient of restitution interpreted as damping in vibroimpact*, J.
    Appl. Mech. 42, 1975, for a damper that grows with the depth.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("pendulum")
        >>> model = model.replace(joints=model.joints.replace(range=[[-1.0, 1.0]]))
        >>> k, d, margin, w = (jnp.array([x]) for x in (1e3, 10.0, 0.0, 1e-3))
        >>> model = model.with_forces(rb.forces.JointLimits(k, d, margin, w, model.joint_names))
        >>> state = model.default_state().replace(q=jnp.array([1.1]))
        >>> rb.applied_forces(model, state).round(6).tolist()
        [-99.5]
    """

    stiffness: jax.Array
    damping: jax.Array
    margin: jax.Array
    width: jax.Array
    joints: tuple[str | int, ...] = eqx.field(static=True)
    positive = ("width",)
    unlimited = ()

    def shapes(self, model: Model) -> Shapes:
        return dict.fromkeys(("stiffness", "damping", "margin", "width"), (len(self.joints),))

    def loads(self, context: Context) -> Loads:
        out: dict[int, Lane] = {}
        for n, joint, depth, along in self._stops(context):
            k, d, w = (_entry(x, n, depth) for x in (self.stiffness, self.damping, self.width))
            rate = inner(along, joint.v)
            f = stop_force(depth, rate, k, d, w)
            for i, a in enumerate(along, joint.start):
                out[i] = add(out.get(i, 0.0), neg(mul(a, f)))
        return Loads(out)

    # No `slopes`: with them, variational steps much longer than sqrt(m / k) converge to a
    # rebound that gains speed. Without them they fail, and `Trajectory.success` is False.

    def energy(self, context: Context) -> Lane:
        """Compute the potential energy of the stops, J."""
        return total(
            stop_energy(depth, *(_entry(x, n, depth) for x in (self.stiffness, self.width)))
            for n, _, depth, _ in self._stops(context)
        )

    def _stops(self, context: Context) -> Iterator[tuple[int, JointState, Lane, list[Lane]]]:
        """Iterate over the stops: index of the joint among the fields, joint, penetration, and the
        direction of increasing penetration."""
        given = (context.model.joints.range, self.stiffness, self.margin)
        ranges, stiffness, margins = (table(x, context.q.dtype) for x in given)
        for n, name in enumerate(self.joints):
            joint = context.joint(name)
            if is_zero(lane(stiffness, n)):
                continue
            index = context.model.joint(name)
            low, high = lane(ranges[:, 0], index), lane(ranges[:, 1], index)
            margin = lane(margins, n)
            x, axis = _coordinate(joint)
            lower, upper = add(low, margin), sub(high, margin)
            if joint.kind != "ball" and _apart(lower, upper):
                yield n, joint, *_nearer(x, lower, upper)
                continue
            if joint.kind != "ball" and not is_infinite(low):
                yield n, joint, sub(lower, x), [neg(a) for a in axis]
            if not is_infinite(high):
                yield n, joint, sub(x, upper), axis


def stop_force(p: Lane, rate: Lane, k: Lane, d: Lane, w: Lane) -> Lane:
    """Compute the force of a stop at the penetration p with the rate `rate`; p < 0 is outside.
    >>> float(stop_force(jnp.array(0.2), jnp.array(1.0), 10.0, 3.0, 0.1))
    4.5
    """
    p, zero = jnp.maximum(p, 0.0), jnp.zeros_like(p)
    onset = p < w
    unit = where(onset, p * p, zero + 1.0)  # common factor, which avoids 0 / 0 at p = 0
    spring = where(onset, zero + k / (2 * w), k * (p - w / 2))
    damper = mul(d, rate) * where(onset, (3 - 2 * p / w) / (w * w), zero + 1.0)
    inward = damper > 0
    slowed = spring - where(inward, zero, damper)
    outward = spring * spring / where(slowed > 0, slowed, zero + 1.0)
    return unit * where(inward, spring + damper, outward)


def stop_energy(p: Lane, k: Lane, w: Lane) -> Lane:
    """Compute the energy of a stop at the penetration p: k p^3 / (6 w), beyond the onset
    k (p^2 / 2 - p w / 2 + w^2 / 6)."""
    p = jnp.maximum(p, 0.0)
    return k * where(p < w, p * p * p / (6 * w), (p * p - p * w) / 2 + w * w / 6)


def _coordinate(joint: JointState) -> tuple[Lane, list[Lane]]:
    """Return the coordinate that has a range, and its gradient by the dofs of the joint. It is q of
    a hinge or slide, and the rotation angle of a ball."""
    if len(joint.q) == 1:
        return joint.q[0], [1.0]
    if joint.kind != "ball":
        raise InputError(
            f"JointLimits: a {joint.kind} joint has no range; name balls and joints of one "
            "coordinate, such as hinges and slides"
        )
    turn = quaternion.log_lanes(list(joint.q))
    angle = safe_sqrt(inner(turn, turn))
    scale = 1 / where(angle > 0, angle, jnp.ones_like(angle))
    return angle, [x * scale for x in turn]


def _apart(low: Lane, high: Lane) -> bool:
    """Return True if both limits are finite constants, so that only one stop acts at a time."""
    known = is_literal(low) and is_literal(high)
    return known and bool(np.isfinite(low) and np.isfinite(high) and low <= high)


def _nearer(x: Lane, low: Lane, high: Lane) -> tuple[Lane, list[Lane]]:
    """Compute the penetration of x into the stop at the nearer end, and its gradient by x. Use it
    if the two stops never act at once."""
    below = x < (low + high) / 2
    end, side = (
        where(below, jnp.full_like(x, a), jnp.full_like(x, b)) for a, b in ((low, high), (-1, 1))
    )
    return side * (x - end), [side]


def is_infinite(x: Lane) -> bool:
    """Return whether a lane is an infinite literal, such as the end of an unlimited range."""
    return is_literal(x) and bool(np.isinf(x))


def _entry(column: Any, n: int, like: Any) -> Lane:
    return lane(table(column, like.dtype), n)
