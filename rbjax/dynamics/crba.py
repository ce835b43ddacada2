"""Composite-rigid-body algorithm: the joint-space inertia matrix (Featherstone, ch. 6).

inward   I_c = I + sum of X^T I_c X of the children;   F = I_c S;   M_ii = S.F + armature
         F travels on to the root, and M_ji = S_j . F at each ancestor j on its way.
"""

from __future__ import annotations

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.drivers import Rolled, Unrolled, driver
from rbjax.dynamics.jacobians import ancestor_mask
from rbjax.dynamics.kinematics import world_poses
from rbjax.lanes import Lane, Sym3, Vec3, add
from rbjax.materialize import materialize
from rbjax.model import WORLD, Model
from rbjax.spatial import Force, Motion, RigidInertia, Transform

_ZERO = RigidInertia(0.0, Vec3.zero(), Sym3.zero())


def composite(x: Any, children: RigidInertia) -> tuple[Any, RigidInertia, Force]:
    """One step: the link's pose in its parent, its composite inertia, and F = I_c S."""
    link, joint = x
    I_c = link.inertia + children
    return joint.transform(link), I_c, I_c(joint.S)


def _unrolled(d: Unrolled, joints: list) -> jax.Array | list[list[Lane]]:
    """Rows of lanes; each F walks to the root by itself."""

    def step(x, children):
        X, I_c, F = composite(x, children)
        return X.rigid_to_parent(I_c), (X, F)

    ys = d.inward(step, _ZERO, d.zip(d.constants, joints))
    n = len(joints)
    M: list[list[Lane]] = [[0.0] * n for _ in range(n)]
    for i, (X, F) in enumerate(ys):
        M[i][i] = add(joints[i].S.dot(F), d.constants[i].armature)
        j = i
        while d.topology.parents[j] != WORLD:
            F = materialize(X.T(F))
            j = d.topology.parents[j]
            X = ys[j][0]
            M[i][j] = M[j][i] = joints[j].S.dot(F)
    return M


def _rolled(d: Rolled, joints: Any, like: jax.Array) -> jax.Array:
    """Composite inertias and axes in world axes, and M as one masked sum of six outer products.

    Each tree is seen from the origin of its own first link, so that f32 keeps its digits.
    """
    top = d.topology
    pose = d.columns(world_poses(d, joints), like)
    first = np.array([chain[0] for chain in top.ancestors], int)
    R, p = pose.R, Vec3(*(x - x[first] for x in pose.p))
    own = d.columns(d.constants, like).inertia
    I_w = Transform(R, p).rigid_to_parent(own)

    def gather(inertia, children):
        I_c = inertia + children
        return I_c, I_c

    I_c = d.columns(d.inward(gather, _ZERO, d.rows(materialize(I_w))), like)
    turns = np.array([link.kind == "hinge" for link in top.links], like.dtype)
    z = R.columns[2]
    S = Motion(z * turns, p.cross(z * turns) + z * (1 - turns))
    S, F = materialize((S, I_c(S)))
    moves = np.stack([ancestor_mask(top, i) for i in range(top.nv)])
    pairs = list(zip(F, S, strict=True))
    # written twice, not transposed: a transposed operand would keep the sum from being vectorized
    below = functools.reduce(jnp.add, (f[:, None] * s[None, :] for f, s in pairs))
    above = functools.reduce(jnp.add, (s[:, None] * f[None, :] for f, s in pairs))
    armature = jnp.where(np.eye(top.nv, dtype=bool), d.prepared.columns.armature, 0.0)
    return jnp.where(moves, below, jnp.where(moves.T, above, 0.0)) + armature


@algorithm("q")
def mass_matrix(model: Model, q: jax.Array) -> jax.Array:
    """M(q) (nv, nv), symmetric positive definite: kinetic energy = v^T M v / 2, armature included.

    Args:
        model: the robot.
        q: (nq,) configuration.

    Returns:
        (nv, nv) kg m^2, kg m or kg.

    Raises:
        InputError: wrong shape or dtype, values that are not finite, zero quaternions.

    Source: Featherstone, *Rigid Body Dynamics Algorithms*, ch. 6 (CRBA).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rb.mass_matrix(model, model.default_state().q).shape
        (2, 2)
    """
    n = model.nv
    if not n:
        return jnp.zeros((0, 0), q.dtype)
    d = driver(model, q.dtype)
    joints = d.joints(q, None)
    if isinstance(d, Rolled):
        return _rolled(d, joints, jnp.zeros(n, q.dtype))
    M = _unrolled(d, joints)
    return d.pack([x for row in M for x in row], jnp.zeros(n * n, q.dtype)).reshape(n, n)
