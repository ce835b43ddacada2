"""First derivatives of inverse and forward dynamics.

    d tau = dID/dq dq + dID/dv dv + M da,      d a = M^-1 (d tau - dID/dq dq - dID/dv dv)
with dq on the tangent space of the configuration (`integrate`). Forward mode through RNEA, nv
tangents side by side: O(nv^2) (Carpentier & Mansard, *Analytical derivatives*, RSS 2018).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics.aba import aba
from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.composites import (
    carried,
    coriolis_block,
    last_of_ball,
    link_axes,
    link_inertias,
    link_twists,
    pair_columns,
    pair_matrix,
    tree_poses,
    twice_coriolis,
    twice_coriolis_transposed,
    with_armature,
)
from rbjax.dynamics.drivers import Driver, driver
from rbjax.dynamics.inverse import InverseMass
from rbjax.lanes import Sym3, Vec3
from rbjax.model import Model, Topology
from rbjax.spatial import Force, Motion, RigidInertia


class InverseDynamicsDerivatives(NamedTuple):
    """d tau with respect to q (tangent), v and a, each (nv, nv); the last is the mass matrix."""

    q: jax.Array
    v: jax.Array
    a: jax.Array


class ForwardDynamicsDerivatives(NamedTuple):
    """d a with respect to q (tangent), v and tau, each (nv, nv); the last is M^-1."""

    q: jax.Array
    v: jax.Array
    tau: jax.Array


def _operands(d: Driver, poses: Any, S: Any, v: jax.Array, a: Any) -> tuple[Any, Any, Any]:
    """What `pair_matrix` makes dID/dq, dID/dv and M of: (above, below) of each."""
    top = d.topology
    V, S_rate = link_twists(d, S, v)

    def accelerate(x, A_parent):
        S, S_rate, speed, qdd = x
        A = A_parent + S * qdd + S_rate * speed
        return A, A

    base = Motion(Vec3.zero(), -d.prepared.gravity)
    rows = d.zip(d.rows(S), d.rows(S_rate), d.lanes(v), a)
    A = d.whole(d.outward(accelerate, base, rows))
    inertias = link_inertias(d, poses)

    def own(inertia, V, A):
        block = coriolis_block(inertia, V)
        return inertia, block, inertia(A) + V.cross_force(block[1])

    nothing = (RigidInertia(0.0, Vec3.zero(), Sym3.zero()), (Sym3.zero(), Force.zero()), Force.zero())
    composite = carried(d, d.each(own, inertias, V, A), nothing)
    before = [_before(top, i) for i in range(top.nv)]
    V, A = d.take(V, before, Motion.zero()), d.take(A, before, base)

    def operands(S, S_rate, V, A, composite):
        inertia, block, force = composite
        drift = V.cross(S)
        bend = A.cross(S) + V.cross(drift)
        both = drift + S_rate
        by_q = S.cross_force(force) + inertia(bend) + twice_coriolis(block, drift.ang)
        by_v = inertia(both) + twice_coriolis(block, S.ang)
        IS = inertia(S)
        row = (*IS, *twice_coriolis_transposed(block, S))
        return by_q, by_v, IS, row, (*bend, *drift.ang), (*both, *S.ang)

    out = d.each(operands, S, S_rate, V, A, composite)
    by_q, by_v, IS, row, column_q, column_v = (d.each(lambda x, k=k: x[k], out) for k in range(6))
    return ((S, by_q), (row, column_q)), ((S, by_v), (row, column_v)), ((S, IS), (IS, S))


def _before(top: Topology, i: int) -> int:
    """A link whose motion says how the axis of link i would move if its joint stood still: the
    parent of a ball's first link for all three, and elsewhere the link itself (S x S = 0)."""
    link = top.links[i]
    return i if last_of_ball(top, i) == i and link.part is None or link.kind == "slide" else top.parents[i - link.part]


@algorithm("q", "v", "a")
def inverse_dynamics_derivatives(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array
) -> InverseDynamicsDerivatives:
    """Derivatives of tau = ID(q, v, a): `(q, v, a)`, each (nv, nv), q on the tangent space.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        a: (nv,) acceleration.

    Source: Carpentier & Mansard (2018).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> s = model.default_state()
        >>> rb.inverse_dynamics_derivatives(model, s.q, s.v, s.v).q.shape
        (2, 2)
    """
    d = driver(model, q.dtype)
    poses = tree_poses(d, d.joints(q, None))
    operands = _operands(d, poses, link_axes(d, poses), v, d.lanes(a))
    by_q, by_v, M = (pair_matrix(d, *pair, v) for pair in operands)
    M = with_armature(d, M)
    return InverseDynamicsDerivatives(by_q, by_v, M)


@algorithm("q", "v", "tau")
def forward_dynamics_derivatives(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array
) -> ForwardDynamicsDerivatives:
    """Derivatives of a = FD(q, v, tau): `(q, v, tau)`, each (nv, nv), q on the tangent space.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        tau: (nv,) generalized force.

    Source: Carpentier & Mansard (2018).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> s = model.default_state()
        >>> rb.forward_dynamics_derivatives(model, s.q, s.v, s.v).tau.shape
        (2, 2)
    """
    d = driver(model, q.dtype)
    joints = d.joints(q, v)
    a, factors = aba(d, joints, d.lanes(tau), d.prepared.gravity)
    _, _, U, inverse_D = d.unzip(factors)
    poses = tree_poses(d, joints)
    S = link_axes(d, poses)
    columns = [pair_columns(d, *pair, v) for pair in _operands(d, poses, S, v, a)[:2]]
    by_q, by_v, inverse = InverseMass(d, poses, S, U, inverse_D, v)(*columns)
    return ForwardDynamicsDerivatives(-by_q, -by_v, inverse)
