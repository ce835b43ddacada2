"""Compliant stops at the ends of the joints' ranges: they push, and never pull.

With p how deep a joint is in its stop (beyond the limit less the margin) and c = d r(p),

    f = k s(p) + c p'                      as it goes in,
    f = (k s(p))^2 / (k s(p) - c p')       as it comes out,

    s(p) = p^2 / (2 w),  r(p) = (p/w)^2 (3 - 2 p/w)   for 0 <= p <= w
    s(p) = p - w/2,      r(p) = 1                     beyond

Going in, the stop is a spring k and a damper d behind an onset of width w; coming out, the damper
fades so that the force stays positive, as it does in Hunt and Crossley's law. The two meet at
p' = 0 with equal slopes, and all begins with slope 0 at p = 0: f is once continuously
differentiable. What the damper adds to k s(p) has the sign of p', so energy is never gained:

    dE/dt = -(f - k s) p' <= 0,      E = ... + k S(p),  S' = s

At rest under a load F the depth is p = F / k + w / 2 (F > k w / 2).
A ball's coordinate is its angle of rotation, with one limit; its stop pushes about the axis of the
rotation.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.forces.context import Context, Joint
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.lanes import Lane, add, inner, is_literal, is_zero, mul, neg, sub, total
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.rotations import quaternion
from rbjax.rotations.coefficients import length, where


class JointLimits(Element):
    """Stops that hold hinges, slides and balls within `model.joints.range`, softly.

    f = k s(p) + d r(p) p' at a growing depth p; while it shrinks the force is never below 0.

    Fields, one entry a joint: stiffness k (n,) N m/rad or N/m; damping d (n,) N m s/rad or N s/m;
    margin (n,) rad or m, how far before the limit the stop begins; width w (n,) rad or m, above 0,
    over which it becomes stiff. Static: `joints`, their names or indices.

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

    def loads(self, now: Context) -> Loads:
        out: dict[int, Lane] = {}
        for n, joint, depth, along in self._stops(now):
            k, d, w = (_entry(x, n, depth) for x in (self.stiffness, self.damping, self.width))
            rate = inner(along, joint.v)
            f = stop_force(depth, rate, k, d, w)
            for i, a in enumerate(along, joint.start):
                out[i] = add(out.get(i, 0.0), neg(mul(a, f)))
        return Loads(out)

    # No `implicit_stiffness`: with one, variational steps much longer than sqrt(m / k) do converge,
    # but a body that strikes the stop leaves it faster than it came. Without it they fail, and
    # `Trajectory.ok` says so.

    def energy(self, now: Context) -> Lane:
        """sum of k S(p)."""
        return total(
            stop_energy(depth, *(_entry(x, n, depth) for x in (self.stiffness, self.width)))
            for n, _, depth, _ in self._stops(now)
        )

    def _stops(self, now: Context) -> Iterator[tuple[int, Joint, Lane, list[Lane]]]:
        """Yield each stop: the index of its joint among the fields, the joint, the depth, and the
        direction of increasing depth."""
        given = (now.model.joints.range, self.stiffness, self.margin)
        ranges, stiffness, margins = (table(x, now.q.dtype) for x in given)
        for n, name in enumerate(self.joints):
            joint = now.joint(name)
            if is_zero(lane(stiffness, n)):
                continue
            index = now.model.joint(name)
            low, high = lane(ranges[:, 0], index), lane(ranges[:, 1], index)
            margin = lane(margins, n)
            x, axis = _coordinate(joint)
            lower, upper = add(low, margin), sub(high, margin)
            if joint.kind != "ball" and _apart(lower, upper):
                yield n, joint, *_nearer(x, lower, upper)
                continue
            if joint.kind != "ball" and not _infinite(low):
                yield n, joint, sub(lower, x), [neg(a) for a in axis]
            if not _infinite(high):
                yield n, joint, sub(x, upper), axis


def stop_force(p: Lane, rate: Lane, k: Lane, d: Lane, w: Lane) -> Lane:
    """The force of a stop at the depth p, which grows at `rate`; p < 0 outside.

    >>> float(stop_force(jnp.array(0.2), jnp.array(1.0), 10.0, 3.0, 0.1))
    4.5
    """
    p, zero = jnp.maximum(p, 0.0), jnp.zeros_like(p)
    onset = p < w
    unit = where(onset, p * p, zero + 1.0)  # taken out of both, so that nothing is 0 / 0 at p = 0
    spring = where(onset, zero + k / (2 * w), k * (p - w / 2))
    damper = mul(d, rate) * where(onset, (3 - 2 * p / w) / (w * w), zero + 1.0)
    inward = damper > 0
    slowed = spring - where(inward, zero, damper)
    outward = spring * spring / where(slowed > 0, slowed, zero + 1.0)
    return unit * where(inward, spring + damper, outward)


def stop_energy(p: Lane, k: Lane, w: Lane) -> Lane:
    """The energy of the spring of a stop at the depth p: k p^3 / (6 w), beyond the onset k (p^2 / 2
    - p w / 2 + w^2 / 6)."""
    p = jnp.maximum(p, 0.0)
    return k * where(p < w, p * p * p / (6 * w), (p * p - p * w) / 2 + w * w / 6)


def _coordinate(joint: Joint) -> tuple[Lane, list[Lane]]:
    """A joint's coordinate, and its gradient by the velocity coordinates."""
    if len(joint.q) == 1:
        return joint.q[0], [1.0]
    if joint.kind != "ball":
        raise InputError(
            f"JointLimits: a {joint.kind} joint has no range; name balls and joints of one "
            "coordinate, such as hinges and slides"
        )
    turn = quaternion.log_lanes(list(joint.q))
    angle = length(inner(turn, turn))
    scale = 1 / where(angle > 0, angle, jnp.ones_like(angle))
    return angle, [x * scale for x in turn]


def _apart(low: Lane, high: Lane) -> bool:
    """Whether two stops never act at once, as far as their limits are compile-time constants."""
    known = is_literal(low) and is_literal(high)
    return known and bool(np.isfinite(low) and np.isfinite(high) and low <= high)


def _nearer(x: Lane, low: Lane, high: Lane) -> tuple[Lane, list[Lane]]:
    """The depth of x in the stop of the nearer end, and the direction of increasing depth. Of two
    stops that never act at once, one evaluation serves both."""
    below = x < (low + high) / 2
    end, side = (
        where(below, jnp.full_like(x, a), jnp.full_like(x, b)) for a, b in ((low, high), (-1, 1))
    )
    return side * (x - end), [side]


def _infinite(x: Lane) -> bool:
    return is_literal(x) and bool(np.isinf(x))


def _entry(column: Any, n: int, like: Any) -> Lane:
    return lane(table(column, like.dtype), n)
