"""Composite-rigid-body algorithm: the joint-space inertia matrix (Featherstone, ch. 6).

inward   I_c = I + sum of X^T I_c X of the children;   F = I_c S;   M_ii = S.F + armature
         F moves on to the root, and M_ji = S_j . F at each ancestor j on its path.

The coordinates of a flexible link have the columns C_j, m_ij of all its frames (factors.py).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.dynamics.algorithms.composites import (
    link_axes,
    link_inertias,
    subtree_sums,
    tree_poses,
)
from rbjax.dynamics.algorithms.factors import Column, add_columns, columns_of_frame
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.drivers.pairs import packed, pair_matrix, with_armature
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.lanes import Lane, Vec3, add, fusion_barrier
from rbjax.model import Model
from rbjax.spatial import RigidInertia


def mass_matrix_rows(d: Driver, joints: Any) -> list[list[Lane]]:
    """Compute the mass matrix M as rows of lanes.
    The momentum F of the subtree of a dof for its unit rate is propagated to the root by itself."""

    def step(x, children):
        link, joint = x
        X, I_c, columns = joint.transform(link), joint.inertia(link) + children[0], children[1]
        if joint.frame_axes is not None:
            columns = columns_of_frame(joint.frame_axes, X, I_c)
            return (X.rigid_to_parent(I_c), columns), (X, columns)
        own = joint.link_inertia(Vec3.zero())
        if own is not None:
            I_c, columns = I_c + own.rigid, add_columns(own, columns)
        if joint.coordinate_of is not None:
            *rest, (F, row) = columns
        else:
            F = I_c(joint.S)
            rest, row = [], (joint.S.dot(F),)
        return (X.rigid_to_parent(I_c), tuple(rest)), (X, Column(F, row))

    ys = d.whole(d.inward(step, (RigidInertia.zero(), ()), d.zip(d.constants, joints)))
    motions, links, top = d.whole(joints), d.whole(d.constants), d.topology
    M: list[list[Lane]] = [[0.0] * top.nv for _ in range(top.nv)]
    for i, (X, (F, row)) in enumerate(ys[: top.nv]):
        first = i + 1 - len(row)
        for j, m in enumerate(row, first):
            M[i][j] = M[j][i] = m
        M[i][i] = add(M[i][i], links[i].armature)
        for j in reversed(top.ancestors[i][:-1]):
            F = fusion_barrier(X.T(F))
            X = ys[j][0]
            if j >= top.nv:
                for k, S in zip(top.links[j].v, motions[j].frame_axes, strict=True):
                    M[i][k] = M[k][i] = S.dot(F)
            elif motions[j].coordinate_of is None:
                M[i][j] = M[j][i] = motions[j].S.dot(F)
    return M


def _by_columns(d: Driver, joints: Any, like: jax.Array) -> jax.Array:
    """Compute M as one masked sum of six outer products of F and S in world axes."""
    d.unroll = 2  # the steps are small
    poses = tree_poses(d, joints)
    S = link_axes(d, poses, joints)
    I_c = subtree_sums(d, link_inertias(d, poses, joints), RigidInertia.zero())
    F = d.each(lambda inertia, S: inertia(S), I_c, S)
    return with_armature(d, pair_matrix(d, (S, F), (F, S), like))


def crba(d: Driver, joints: Any, like: jax.Array) -> jax.Array:
    """Compute the mass matrix M (nv, nv) from the joint motions."""
    return packed(mass_matrix_rows(d, joints), like) if d.listed else _by_columns(d, joints, like)


@algorithm("q", long=True)
def mass_matrix(model: Model, q: ArrayLike) -> jax.Array:
    """Compute the mass matrix M(q), including armature: kinetic energy = v^T M v / 2.

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
    return crba(d, d.joints(q, None), jnp.zeros(n, q.dtype))
