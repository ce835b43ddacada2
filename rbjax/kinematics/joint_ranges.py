"""Joint ranges, on the manifold of configurations.

A joint with one coordinate stays within [lower, upper]. The rotation angle of a ball joint has an
upper bound. Other joints have no range. `Ranges.within` projects each joint to the nearest point of
its range, so the ranges hold exactly.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, is_literal
from rbjax.model import Model, joint_slices
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.rotations import quaternion

#: m, half-width of the interval of random lengths, for joints without a range
SPREAD = 0.5


class BoundedCoordinate(NamedTuple):
    """A coordinate with a range: its indices in q and in v, and its bounds."""

    q: int
    v: int
    lower: Lane
    upper: Lane


class BallRange(NamedTuple):
    """A ball joint with a range: its slices of q and v, and its largest angle, rad."""

    q: slice
    v: slice
    most: Lane


class Ranges:
    """The joint ranges of a model, as lanes. It is empty if `limits` is false."""

    def __init__(self, model: Model, dtype: Any, limits: bool = True):
        self.bounded: list[BoundedCoordinate] = []
        self.balls: list[BallRange] = []
        if not limits:
            return
        rows = table(model.joints.range, dtype)
        for j, (joint, span) in enumerate(_joints(model)):
            lower, upper = lane(rows[:, 0], j), lane(rows[:, 1], j)
            if is_literal(lower) and is_literal(upper) and np.isinf([lower, upper]).all():
                continue
            if joint.nv == 1 and not span.attitude:
                at = BoundedCoordinate(
                    span.q.start, span.v.start, jnp.asarray(lower, dtype), jnp.asarray(upper, dtype)
                )
                self.bounded.append(at)
            elif joint.name == "ball":
                turn, by = span.attitude
                self.balls.append(BallRange(turn, by, jnp.asarray(upper, dtype)))

    def within(self, q: Sequence[Lane]) -> list[Lane]:
        """Return the configuration with each joint projected to the nearest point of its range."""
        out = list(q)
        for at in self.bounded:
            out[at.q] = jnp.clip(out[at.q], at.lower, at.upper)
        for ball in self.balls:
            turn = quaternion.log_lanes(out[ball.q])
            angle = quaternion.angle_lanes(out[ball.q][0], out[ball.q][1:])
            over = angle > ball.most
            shrink = ball.most / jnp.where(over, angle, 1.0)
            held = quaternion.exp_lanes([x * shrink for x in turn])
            out[ball.q] = [jnp.where(over, a, b) for a, b in zip(held, out[ball.q], strict=True)]
        return out

    def free(self, q: Sequence[Lane], g: Sequence[Lane]) -> dict[int, Lane]:
        """Return a mask for each bounded coordinate, keyed by its index in v. It is 0 at a bound if
        the direction g (nv lanes) points out of the range, else 1."""
        out: dict[int, Lane] = {}
        for at in self.bounded:
            x, out_of = q[at.q], g[at.v]
            held = ((x <= at.lower) & (out_of < 0)) | ((x >= at.upper) & (out_of > 0))
            out[at.v] = jnp.where(held, 0.0, 1.0).astype(jnp.result_type(x))
        return out

    def outward(self, q: Sequence[Lane], g: Sequence[Lane]) -> dict[int, list[Lane]]:
        """Return the axis along which the angle of each ball joint grows, keyed by the start of its
        slice of v. It is zero unless the joint is at its bound and g points out of the range."""
        out: dict[int, list[Lane]] = {}
        for ball in self.balls:
            turn = quaternion.log_lanes(list(q[ball.q]))
            square = sum(x * x for x in turn)
            angle = jnp.sqrt(jnp.where(square > 0, square, 1.0))
            grows = sum(a * b for a, b in zip(turn, g[ball.v], strict=True))
            tiny = 8 * float(jnp.finfo(angle.dtype).eps)
            held = (square > 0) & (angle >= ball.most * (1 - tiny)) & (grows > 0)
            out[ball.v.start] = [jnp.where(held, x / angle, 0.0) for x in turn]
        return out


def random_configurations(
    model: Model, key: jax.Array, count: int, near: jax.Array, limits: bool = True
) -> jax.Array:
    """Draw configurations (count, nq), uniform within the joint ranges. For joints without a range,
    angles are within pi and lengths within `SPREAD` of `near`; attitudes are uniform on SO(3)."""
    dtype = near.dtype
    unit = jax.random.uniform(key, (count, model.nq), dtype)
    q: list[jax.Array] = []
    for j, (joint, span) in enumerate(_joints(model)):
        low, high = (jnp.asarray(x, dtype) for x in model.joints.range[j])
        for n, i in enumerate(range(span.q.start, span.q.stop)):
            spread = SPREAD if _slides(joint, n) else math.pi
            ranged = limits and joint.nv == 1
            if ranged and not isinstance(low, jax.core.Tracer) and np.isfinite([low, high]).all():
                lower, upper = low, high  # independent of `near`: a batch shares the starts
            else:
                lower, upper = near[i] - spread, near[i] + spread
            if ranged:
                lower = jnp.where(jnp.isfinite(low), low, jnp.minimum(lower, high))
                upper = jnp.where(jnp.isfinite(high), high, jnp.maximum(upper, low))
            q.append(lower + (upper - lower) * unit[:, i])
        if span.attitude:
            most = jnp.where(jnp.isfinite(high), high, math.pi) if limits else math.pi
            q += _attitudes(
                [unit[:, i] for i in range(span.attitude[0].start, span.attitude[0].stop)],
                joint,
                most,
            )
    return jnp.stack([jnp.broadcast_to(x, (count,)) for x in q], -1)


def _attitudes(unit: list[jax.Array], joint: Any, most: Any) -> list[jax.Array]:
    """Return uniform quaternions (Shoemake 1992); scale the angles of ball joints to `most`."""
    a, b, c, _ = unit
    one, two = jnp.sqrt(1 - a), jnp.sqrt(a)
    b, c = 2 * math.pi * b, 2 * math.pi * c
    turn = [two * jnp.cos(c), one * jnp.sin(b), one * jnp.cos(b), two * jnp.sin(c)]
    if joint.name != "ball":
        return turn
    phi = quaternion.log_lanes(turn)
    return quaternion.exp_lanes([x * (most / math.pi) for x in phi])


def _slides(joint: Any, n: int) -> bool:
    """Return whether coordinate n of a joint is a length."""
    kind = joint.dofs[n].kind
    return bool(kind.linear) and not kind.angular


def _joints(model: Model) -> Iterator[tuple[Any, Any]]:
    return zip(model.topology.joints, joint_slices(model.topology), strict=True)
