"""Springs and dampers of the joints.

    tau = -K (q - q_rest) - D v
K acts on the tangent of the configuration (MuJoCo, *Computation*, passive forces). The numbers are
the model's own: joints.stiffness, joints.springref, joints.damping.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from rbjax.dynamics.algorithms.manifold import difference_lanes
from rbjax.forces.element import Element, Loads
from rbjax.forces.instant import Instant
from rbjax.lanes import Lane, add, is_zero, mul, neg, total
from rbjax.model.leaves import table
from rbjax.model.links import lane


class JointSprings(Element):
    """The springs and dampers that a model's joints have."""

    def loads(self, now: Instant) -> Loads:
        v = now.v
        damping = table(now.model.joints.damping, v.dtype)
        out = {i: neg(mul(lane(damping, i), v[i])) for i in range(now.model.nv)}
        for k, at, stretch in _stretched(now):
            for i, x in enumerate(stretch, at):
                out[i] = add(out[i], neg(mul(k, x)))
        return Loads(out)

    def chord(self, now: Instant, h: Any) -> dict[int, Lane]:
        top, dtype = now.model.topology, now.v.dtype
        joints = now.model.joints
        damping, stiffness = table(joints.damping, dtype), table(joints.stiffness, dtype)
        out: dict[int, Lane] = {}
        for j, (joint, at) in enumerate(zip(top.joints, top.joint_v, strict=True)):
            spring = mul(h * h / 4, lane(stiffness, j))
            for i in range(at, at + joint.nv):
                out[i] = add(mul(h / 2, lane(damping, i)), spring)
        return out

    def energy(self, now: Instant) -> Lane:
        """sum of k |q - q_rest|^2 / 2."""
        return total(mul(mul(0.5, k), total(x * x for x in d)) for k, _, d in _stretched(now))


def _stretched(now: Instant) -> list[tuple[Lane, int, list[Lane]]]:
    """Of each spring its stiffness, its first velocity coordinate, and how far it is stretched."""
    stiffness = table(now.model.joints.stiffness, now.q.dtype)
    ks = [lane(stiffness, j) for j in range(len(now.model.topology.joint_kinds))]
    starts = now.model.topology.joint_v
    return [(k, starts[j], stretch(now, j)) for j, k in enumerate(ks) if not is_zero(k)]


def stretch(now: Instant, joint: int) -> list[Lane]:
    """How far a joint is from the rest of its spring, in the coordinates of v."""
    top, rest = now.model.topology, table(now.model.joints.springref, now.q.dtype)
    kind, start = top.joints[joint], top.joint_q[joint]
    at = range(start, start + kind.nq)
    return difference_lanes(_Alone((kind,)), [lane(rest, i) for i in at], [now.q[i] for i in at])


class _Alone(NamedTuple):
    """The topology of one joint, for `difference_lanes`."""

    joints: tuple[Any]
    joint_q: tuple[int] = (0,)
    joint_v: tuple[int] = (0,)
