"""First derivatives of inverse and forward dynamics.

    d tau = dID/dq dq + dID/dv dv + M da,      d a = M^-1 (d tau - dID/dq dq - dID/dv dv)

with dq on the tangent space of the configuration (`integrate`). In world axes, with V and A the
twist and spatial acceleration of what carries joint j, a tangent dq_j turns all that j moves as a
rigid body, so that for each body k of it (Singh, Russell & Wensing 2022)

    df_k / dq_j = S_j x* f_k + I_k (A x S_j + V x V x S_j) + 2 B_k (V x S_j)
    df_k / dv_j = I_k (V x S_j + S_j') + 2 B_k S_j

with B of `coriolis_block`. Summed over what a link carries these are composites, and an entry
(i, j) is a product with S_i: O(n), and then O(depth) a column. Where j moves i, the turning of f
and that of S_i cancel. For forward dynamics the columns are solved with ABA's factors (inverse.py).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics.aba import aba
from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.composites import (
    coriolis_block,
    link_axes,
    link_twists,
    tree_poses,
    turning,
    twice_coriolis,
    twice_coriolis_transposed,
)
from rbjax.dynamics.columns import (
    by_column,
    kernel,
    lane_rows,
    pair_columns_of,
    row,
    rows_of,
    solved,
)
from rbjax.dynamics.drivers import Driver, driver, on_threads
from rbjax.dynamics.inverse import InverseMass
from rbjax.dynamics.pairs import pair_matrix, with_armature
from rbjax.lanes import Lane, Sym3, Vec3, add
from rbjax.materialize import batch_last
from rbjax.model import Model, Topology, prepare
from rbjax.spatial import Force, Motion, RigidInertia
from rbjax.threads import threaded

#: designs to be timed: accelerations in a kernel of their own; products with M^-1 by XLA
SPLIT, PRODUCTS = True, False


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


class Operands(NamedTuple):
    """Of each link what `pair_matrix` multiplies: for entry (i, j) the row of link i by a column of
    link j where j moves i, elsewhere the axis of i by a force of j."""

    force_q: Force
    force_v: Force
    force_a: Force
    row: tuple[Lane, ...]
    column_q: tuple[Lane, ...]
    column_v: tuple[Lane, ...]


def operands(
    d: Driver, poses: Any, S: Any, v: jax.Array, a: Any, kept: Callable | None = None, *given: Any
) -> Any:
    """`Operands` at accelerations `a` per link, or what kept(pose, S, operands, *given) makes of
    those of each link; per link."""
    V = link_twists(d, S, v)
    base = Motion(Vec3.zero(), -d.prepared.gravity)
    before = [_before(d.topology, i) for i in range(d.topology.nv)]
    V_before, T = d.take(V, before, Motion.zero()), turning(d, V)
    no_balls = T is V_before

    def accelerate(x, A_parent):
        S, V_before, speed, qdd = x
        A = A_parent + S * qdd + V_before.cross(S) * speed
        return A, A

    A = d.whole(d.outward(accelerate, base, d.zip(d.rows(S), d.rows(V_before), d.lanes(v), a)))
    A_before = d.take(A, before, base)

    def gather(x, children):
        link, (pose, S, V, A, T, V_before, A_before), *more = x
        inertia = pose.rigid_to_parent(link.inertia)
        block = coriolis_block(inertia, V)
        own = inertia, block, inertia(A) + V.cross_force(block[1])
        inertia, block, force = composite = jax.tree.map(add, own, children)
        drift = V_before.cross(S)
        bend = A_before.cross(S) + V_before.cross(drift)
        both = drift * 2.0 if no_balls else drift + T.cross(S)
        IS = inertia(S)
        out = Operands(
            S.cross_force(force) + inertia(bend) + twice_coriolis(block, drift.ang),
            inertia(both) + twice_coriolis(block, S.ang),
            IS,
            (*IS, *twice_coriolis_transposed(block, S)),
            (*bend, *drift.ang),
            (*both, *S.ang),
        )
        return composite, out if kept is None else kept(pose, S, out, *more)

    massless = RigidInertia(0.0, Vec3.zero(), Sym3.zero())
    nothing = massless, (Sym3.zero(), Force.zero()), Force.zero()
    rows = d.zip(*map(d.rows, (poses, S, V, A, T, V_before, A_before)))
    return d.inward(gather, nothing, d.zip(d.constants, rows, *given))


def whole_operands(d: Driver, *args: Any) -> Operands:
    """`operands`, each of them in the form of `Driver.whole`."""
    return Operands(*map(d.whole, d.unzip(operands(d, *args), len(Operands._fields))))


def _before(top: Topology, i: int) -> int:
    """The link whose motion says how the axis of link i moves while its own joint stands still: of
    a ball the parent of the first link, elsewhere the link itself, as S x S = 0."""
    link = top.links[i]
    if link.kind == "slide" or link.part is None:
        return i
    return top.parents[i - link.part]


def inverse_pairs(S: Any, x: Operands) -> tuple:
    """What `pair_matrix` multiplies for dID/dq, dID/dv and M."""
    return (
        ((S, x.force_q), (x.row, x.column_q)),
        ((S, x.force_v), (x.row, x.column_v)),
        ((S, x.force_a), (x.force_a, S)),
    )


def inverse_by_columns(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array
) -> InverseDynamicsDerivatives:
    """`inverse_dynamics_derivatives` as two kernels."""
    model = on_threads(model, q.dtype)

    def link(pose, S, x):
        return row(v, S, x.row, *seconds(inverse_pairs(S, x)))

    def links(q, v, a):
        d = driver(model, q.dtype)
        poses = tree_poses(d, d.joints(q, None))
        S = link_axes(d, poses)
        return rows_of(d, operands(d, poses, S, v, d.lanes(a), link), 57, v)

    rows = kernel(links, q, v, a)

    def column(own, places, unit):
        S, x = rows[:, :6], rows[:, 6:15]
        armature = jnp.asarray(prepare(model, v.dtype).columns.armature, v.dtype)
        *first, M = pair_columns_of([(S, x), (S, x), (S, x[:, :6])], own[15:], places)
        return [*first, M + unit * armature]

    return InverseDynamicsDerivatives(*by_column(model, rows, column))


def seconds(pairs: tuple) -> list:
    """The second factors of `pair_matrix`."""
    return [b for pair in pairs for _, b in pair]


@algorithm("q", "v", "a", apart=inverse_by_columns)
def inverse_dynamics_derivatives(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array
) -> InverseDynamicsDerivatives:
    """Derivatives of tau = ID(q, v, a): `(q, v, a)`, each (nv, nv), q on the tangent space.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        a: (nv,) acceleration.

    Source: Carpentier & Mansard (2018); Singh, Russell & Wensing (2022), RA-L 7(2).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> s = model.default_state()
        >>> rb.inverse_dynamics_derivatives(model, s.q, s.v, s.v).q.shape
        (2, 2)
    """
    if not model.nv:
        return InverseDynamicsDerivatives(*(jnp.zeros((0, 0), q.dtype),) * 3)
    d = driver(model, q.dtype)
    poses = tree_poses(d, d.joints(q, None))
    S = link_axes(d, poses)
    x = whole_operands(d, poses, S, v, d.lanes(a))
    by_q, by_v, M = (pair_matrix(d, *pair, v) for pair in inverse_pairs(S, x))
    return InverseDynamicsDerivatives(by_q, by_v, with_armature(d, M))


def forward_by_columns(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array
) -> ForwardDynamicsDerivatives:
    """`forward_dynamics_derivatives` as several kernels."""
    model = on_threads(model, q.dtype)

    def accelerations(q, v, tau):
        d = driver(model, q.dtype)
        a, factors = aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity)
        _, _, U, inverse_D = d.unzip(factors, 4)
        return lane_rows(d, d.zip(a, inverse_D, U), v)

    def link(pose, S, x, inverse_D, U):
        U = pose.T(Force.from_lanes(U))
        return row(v, S, U, [inverse_D], x.row, *seconds(inverse_pairs(S, x)[:2]))

    def links(q, v, found):
        d = driver(model, q.dtype)
        a, inverse_D, *U = map(d.lanes, found)
        poses = tree_poses(d, d.joints(q, None))
        S = link_axes(d, poses)
        return rows_of(d, operands(d, poses, S, v, a, link, inverse_D, d.zip(*U)), 52, v)

    if SPLIT:
        rows = kernel(links, q, v, threaded(accelerations)(*batch_last((q, v, tau))))
    else:
        rows = kernel(lambda q, v, tau: links(q, v, accelerations(q, v, tau)), q, v, tau)

    def column(own, places, unit):
        S, x, factors = rows[:, :6], rows[:, 13:22], rows[:, :13]
        X = pair_columns_of([(S, x), (S, x)], own[22:], places)
        if PRODUCTS:
            return [*X, solved(model, factors, unit)]
        return [*(-solved(model, factors, x) for x in X), solved(model, factors, unit)]

    *out, inverse = by_column(model, rows, column)
    if PRODUCTS:
        out = [-jnp.matmul(inverse, x, precision=jax.lax.Precision.HIGHEST) for x in out]
    return ForwardDynamicsDerivatives(*out, inverse)


@algorithm("q", "v", "tau", pairs=True, apart=forward_by_columns)
def forward_dynamics_derivatives(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array
) -> ForwardDynamicsDerivatives:
    """Derivatives of a = FD(q, v, tau): `(q, v, tau)`, each (nv, nv), q on the tangent space.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        tau: (nv,) generalized force.

    Source: Carpentier & Mansard (2018); Singh, Russell & Wensing (2022), RA-L 7(2).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> s = model.default_state()
        >>> rb.forward_dynamics_derivatives(model, s.q, s.v, s.v).tau.shape
        (2, 2)
    """
    if not model.nv:
        return ForwardDynamicsDerivatives(*(jnp.zeros((0, 0), q.dtype),) * 3)
    d = driver(model, q.dtype)
    joints = d.joints(q, v)
    a, factors = aba(d, joints, d.lanes(tau), d.prepared.gravity)
    _, _, U, inverse_D = d.unzip(factors, 4)
    poses = tree_poses(d, joints)
    S = link_axes(d, poses)
    x = whole_operands(d, poses, S, v, a)
    by_q, by_v, inverse = InverseMass(d, poses, S, U, inverse_D, v)(*inverse_pairs(S, x)[:2])
    return ForwardDynamicsDerivatives(by_q, by_v, inverse)
