"""The Coriolis matrix (Echeandia & Wensing 2021).

With S_i a link's unit twist, V_i its twist and B(I, V) = (V x* I - I V x + (I V) x-bar*) / 2,

    C = sum over bodies of J^T (I J' + B J),   J'_i = V_i x S_i,

with C v + g = b and M' = C + C^T. Two of the four blocks of B are zero (`Coriolis`).

C is linear in v. Its values at the unit velocities give the coefficients of Lagrange's equations:

    tau_i = sum_j D_ij a_j + sum_jk D_ijk v_j v_k + D_i

In a tree with flexible links, let y = [V; q'] = J v be the twist of a link in its own axes, with
the rates of its coordinates if it has an inertia I(q) over both. A prime is a time derivative:

    C = sum over links of J^T (I J' + N J),
    N = (I' + P - P^T) / 2 + Q,    P = [0, d(I y)/dq],   Q = blockdiag(-[[h~, p~], [p~, 0]], 0)

with [h; p] the momentum of the link, the part of I y for V. Q and P - P^T are skew, so M' = C + C^T
for the mass matrix M = sum of J^T I J (Lagrange's equations in quasi-velocities, Hamel 1904). The
stiffness of rotation of modal bodies (`rbjax.flexible.modal`) is not part of C.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.display import displayed
from rbjax.dynamics.algorithms.body_jacobians import body_jacobians
from rbjax.dynamics.algorithms.composites import (
    Coriolis,
    axis_rates,
    link_axes,
    link_inertias,
    link_twists,
    subtree_sums,
    tree_poses,
)
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.dynamics.algorithms.rnea import gravity_forces
from rbjax.dynamics.arguments import check_arrays
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.drivers.pairs import pair_matrix
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.joints import LinkInertia
from rbjax.lanes import Vec3, as_arrays, matmat, matvec
from rbjax.model import Model, prepare
from rbjax.spatial import Force, Motion, RigidInertia


@algorithm("q", "v")
def coriolis_matrix(model: Model, q: ArrayLike, v: ArrayLike) -> jax.Array:
    """Compute the Coriolis matrix C, with C v + gravity_forces = bias_forces and M' - 2 C skew.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Returns:
        (nv, nv); C v is in N and N m.

    Source: Echeandia & Wensing (2021), *Numerical methods to compute the Coriolis matrix*.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> state = model.default_state()
        >>> rb.coriolis_matrix(model, state.q, state.v).shape
        (2, 2)
    """
    if not model.nv:
        return jnp.zeros((0, 0), q.dtype)
    if model.topology.frames:
        return _flexible_coriolis_matrix(model, q, v)
    d = driver(model, q.dtype)
    joints = d.joints(q, v)
    poses = tree_poses(d, joints)
    S, inertias = link_axes(d, poses, joints), link_inertias(d, poses, joints)
    V = link_twists(d, S, v)
    S_rate = axis_rates(d, V, S, poses, joints)
    B = d.each(Coriolis.of, inertias, V)
    nothing = (RigidInertia.zero(), Coriolis.zero())
    composite = subtree_sums(d, d.each(lambda *x: x, inertias, B), nothing)

    def forces(S, S_rate, composite):
        inertia, B = composite
        return inertia(S_rate) + B(S.ang), (*inertia(S), *B.transposed(S))

    both = d.each(forces, S, S_rate, composite)
    outer, inner = d.each(lambda x: x[0], both), d.each(lambda x: x[1], both)
    axes = d.each(lambda S, S_rate: (*S_rate, *S.ang), S, S_rate)
    return pair_matrix(d, (S, outer), (inner, axes), v)


@displayed
class LagrangeCoefficients(NamedTuple):
    """The coefficients of tau_i = D_ij a_j + D_ijk v_j v_k + D_i at a configuration.

    - inertia: D_ij (nv, nv); D_ii is the effective inertia of dof i, D_ij couples i and j.
    - velocity: D_ijk (nv, nv, nv), symmetric in j and k; D_ijj is centripetal, the others Coriolis.
    - gravity: D_i (nv,).
    """

    inertia: jax.Array
    velocity: jax.Array
    gravity: jax.Array


def lagrange_coefficients(model: Model, q: ArrayLike) -> LagrangeCoefficients:
    """Compute the inertial, centripetal, Coriolis and gravity coefficients of Lagrange's equations.

    Use it to read the equations of motion of a robot term by term. `bias_forces` and
    `forward_dynamics` compute the sums faster.

    Args:
        model: the robot.
        q: (nq,) configuration, in rad and m.

    Returns:
        `LagrangeCoefficients`, in SI units.

    Raises:
        InputError: q does not fit the model.

    Source: Cai Zixing, *Robotics*, 4.1.1, equations (4.8) to (4.10), table 4.1.

    Example:
        >>> import jax.numpy as jnp
        >>> import rbjax as rb
        >>> arm = rb.load("two_link")  # the arm of table 4.1
        >>> found = rb.lagrange_coefficients(arm, jnp.zeros(2))
        >>> found.inertia.round(3).tolist()
        [[6.0, 2.0], [2.0, 1.0]]
    """
    q = check_arrays("lagrange_coefficients", model, {"q": q})["q"]
    inertia = mass_matrix(model, q)
    unit = jnp.eye(model.nv, dtype=inertia.dtype)
    C = jax.vmap(lambda v: coriolis_matrix(model, q, v))(unit)  # C[k, i, j]
    velocity = (jnp.moveaxis(C, 0, 2) + jnp.moveaxis(C, 0, 1)) / 2
    return LagrangeCoefficients(inertia, velocity, gravity_forces(model, q))


def _flexible_coriolis_matrix(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute `coriolis_matrix` (nv, nv) of a tree with flexible links."""
    h = jnp.zeros((), q.dtype)
    J, J_rate = jax.jvp(
        lambda h: body_jacobians(model, integrate(model, q, h * v)), (h,), (jnp.ones_like(h),)
    )
    d = Unrolled(model, prepare(model, q.dtype))
    C = jnp.zeros((model.nv, model.nv), q.dtype)
    for i, (link, joint) in enumerate(zip(d.constants, d.joints(q, v), strict=True)):
        M = rigid_matrix(joint.inertia(link), q.dtype)
        C = C + matmat(
            J[i].T, matmat(M, J_rate[i]) + matmat(_momentum_matrix(M, matvec(J[i], v)), J[i])
        )
        if joint.link_inertia(Vec3.zero()) is not None:
            C = C + _of_link_inertia(model, joint, i, J[i], J_rate[i], v)
    return C


def _of_link_inertia(model: Model, joint: Any, i: int, J: Any, J_rate: Any, v: Any) -> jax.Array:
    """Compute the part of C of a `LinkInertia`."""
    at = jnp.array(list(model.topology.links[i].v))
    count, none = len(at), [0.0] * len(at)
    unit = jnp.zeros((count, model.nv), v.dtype).at[jnp.arange(count), at].set(1.0)
    J, J_rate = jnp.concatenate([J, unit]), jnp.concatenate([J_rate, 0 * unit])
    q, y = jnp.stack(as_arrays(list(joint.q), v[0])), matvec(J, v)

    def matrix(q: jax.Array) -> jax.Array:
        inertia = joint.joint.inertia(list(q), none, Vec3.zero(), joint.params)
        return link_matrix(inertia, v.dtype)

    M, rate = jax.jvp(matrix, (q,), (v[at],))
    by_q = jax.jacfwd(lambda q: matvec(matrix(q), y))(q)
    P = jnp.concatenate([jnp.zeros((len(y), 6), v.dtype), by_q], 1)
    N = (rate + P - P.T) / 2 + _momentum_matrix(M, y)
    return matmat(J.T, matmat(M, J_rate) + matmat(N, J))


def _momentum_matrix(M: jax.Array, y: jax.Array) -> jax.Array:
    """Return Q, with Q y = V x* (M y) for the part of V and zero for the part of q'."""
    momentum = matvec(M, y)
    h, p = _skew(momentum[:3]), _skew(momentum[3:6])
    Q = -jnp.block([[h, p], [p, jnp.zeros_like(p)]])
    return jnp.zeros_like(M).at[:6, :6].set(Q)


def _skew(x: jax.Array) -> jax.Array:
    o = jnp.zeros_like(x[0])
    return jnp.stack([o, -x[2], x[1], x[2], o, -x[0], -x[1], x[0], o]).reshape(3, 3)


def rigid_matrix(inertia: RigidInertia, dtype: Any) -> jax.Array:
    """Return the spatial inertia (6, 6) of a rigid body, angular part first."""
    like = jnp.zeros((), dtype)
    columns = [inertia(Motion.from_lanes([float(k == j) for k in range(6)])) for j in range(6)]
    return jnp.stack([jnp.stack(as_arrays([*f], like)) for f in columns], -1)


def link_matrix(inertia: LinkInertia, dtype: Any) -> jax.Array:
    """Return the inertia (6 + n, 6 + n) of a flexible link over its base and coordinates."""
    like = jnp.zeros((), dtype)

    def column(f: Force) -> jax.Array:
        return jnp.stack(as_arrays([*f], like))

    C = jnp.stack([column(f) for f in inertia.coupling], -1)
    m = jnp.stack([jnp.stack(as_arrays(list(row), like)) for row in inertia.mass])
    return jnp.block([[rigid_matrix(inertia.rigid, dtype), C], [C.T, m]])
