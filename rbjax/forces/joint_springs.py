"""Springs and dampers of the joints.

    tau = -K (q - q_rest) - D v
K acts on the tangent of the configuration (MuJoCo, *Computation*, passive forces). The numbers are
the model's own: joints.stiffness, joints.springref, joints.damping.
"""

from __future__ import annotations

import numpy as np

from rbjax.dynamics.manifold import difference_lanes
from rbjax.forces.element import Element, Loads
from rbjax.forces.instant import Instant, table
from rbjax.lanes import Lane, add, is_zero, mul, neg, total
from rbjax.model import JOINT_SIZES
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

    def energy(self, now: Instant) -> Lane:
        """sum of k |q - q_rest|^2 / 2."""
        return total(mul(mul(0.5, k), total(x * x for x in d)) for k, _, d in _stretched(now))


def _stretched(now: Instant) -> list[tuple[Lane, int, list[Lane]]]:
    """Of each spring its stiffness, its first velocity coordinate, and how far it is stretched."""
    model, q = now.model, now.q
    top, joints = model.topology, model.joints
    stiffness = table(joints.stiffness, q.dtype)
    if isinstance(stiffness, np.ndarray) and not stiffness.any():
        return []
    rest = table(joints.springref, q.dtype)
    at_rest = [lane(rest, i) for i in range(top.nq)]
    stretch = difference_lanes(top, at_rest, [q[i] for i in range(top.nq)])
    out = []
    for j, (kind, at) in enumerate(zip(top.joint_kinds, top.joint_v, strict=True)):
        k = lane(stiffness, j)
        if not is_zero(k):
            out.append((k, at, stretch[at : at + JOINT_SIZES[kind][1]]))
    return out
