"""The Coriolis matrix (Echeandia & Wensing 2021).

With S_i a link's unit twist, V_i its twist and B(I, V) = (V x* I - I V x + (I V) x-bar*) / 2,

    C = sum over bodies of J^T (I J' + B J),   J'_i = V_i x S_i,

with C v + g = b and M' = C + C^T. Two of the four blocks of B are zero (`Coriolis`).

C is linear in v. Its values at the unit velocities give the coefficients of Lagrange's equations:

    tau_i = sum_j D_ij a_j + sum_jk D_ijk v_j v_k + D_i
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.body_jacobians import ancestor_mask
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
from rbjax.dynamics.algorithms.flexible_coriolis import flexible_coriolis_matrix
from rbjax.dynamics.algorithms.rnea import gravity_forces
from rbjax.dynamics.arguments import check_arrays
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.drivers.pairs import pair_matrix
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.lanes import mul
from rbjax.model import Model
from rbjax.spatial import Force, Motion, RigidInertia


@algorithm("q", "v")
def coriolis_matrix(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the Coriolis matrix C, with C v + gravity_forces = bias_forces and M' - 2 C skew.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.

    Returns:
        (nv, nv); M' = C + C^T along the motion.

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
        return flexible_coriolis_matrix(model, q, v)
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
    C = pair_matrix(d, (S, outer), (inner, axes), v)
    return C + _of_modes(d, joints, poses, S, S_rate, V, v) if model.topology.flexible else C


def _of_modes(
    d: Driver, joints: Any, poses: Any, S: Any, S_rate: Any, V: Any, v: jax.Array
) -> jax.Array:
    """Compute the part of the Coriolis matrix C that modal inertias add to their rigid inertias.

    With J extended by the row of the coordinate, the blocks of B for a link with the rate q' are
    [q' I_q / 2, V x* C + q' C_q + I_q V / 2; -(I_q V)^T / 2, q' m_q / 2].
    """

    def in_world(pose, V, modal, slope):
        I_q, C, C_q = (
            pose.rigid_to_parent(slope.rigid), pose.T(modal.coupling), pose.T(slope.coupling),
        )  # fmt: skip
        return I_q, C, V.cross_force(C), C_q, I_q(V) * -0.5, mul(0.5, slope.mass)

    found = d.each(in_world, poses, V, *d.modes(joints))
    axes, rates = (d.stack(x, list, v) for x in (S, S_rate))
    out = jnp.zeros((len(v), len(v)), v.dtype)
    for i in (i for i, dof in enumerate(d.topology.dofs) if dof.kind.modal):
        here = d.take(found, [i])
        I_q, C, VC, C_q, lever, half_m = here[0] if d.listed else here
        moves = jnp.asarray(ancestor_mask(d.topology, i), v.dtype)[:, None]
        J, J_rate = (Motion.from_lanes((x * moves).T) for x in (axes, rates))
        column = J.dot(VC + C_q * v[i] - lever)
        row = J_rate.dot(C) + J.dot(lever)
        out = out.at[:, i].add(column).at[i].add(row).at[i, i].add(jnp.squeeze(half_m * v[i]))
        out = out + _products(J, I_q(J) * (0.5 * v[i]))
    return out


def _products(a: Motion, b: Force) -> jax.Array:
    """Compute the matrix with the entries a_i . b_j."""
    pairs = zip(a, b, strict=True)
    return functools.reduce(jnp.add, (x[:, None] * jnp.asarray(y)[None] for x, y in pairs))


class LagrangeCoefficients(NamedTuple):
    """The coefficients of tau_i = D_ij a_j + D_ijk v_j v_k + D_i at a configuration.

    - inertia: D_ij (nv, nv); D_ii is the effective inertia of dof i, D_ij couples i and j.
    - velocity: D_ijk (nv, nv, nv), symmetric in j and k; D_ijj is centripetal, the others Coriolis.
    - gravity: D_i (nv,).
    """

    inertia: jax.Array
    velocity: jax.Array
    gravity: jax.Array


def lagrange_coefficients(model: Model, q: jax.Array) -> LagrangeCoefficients:
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
