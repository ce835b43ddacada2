"""The Coriolis matrix (Echeandia & Wensing 2021).

With S_i a link's unit twist, V_i its twist and B(I, V) = (V x* I - I V x + (I V) x-bar*) / 2,

    C = sum over bodies of J^T (I J' + B J),   J'_i = V_i x S_i,

with C v + g = b and M' = C + C^T. Two of the four blocks of B are zero (`Coriolis`).

C is linear in v. Its values at the unit velocities give the coefficients of Lagrange's equations:

    tau_i = sum_j D_ij a_j + sum_jk D_ijk v_j v_k + D_i
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.display import displayed
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
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.drivers.pairs import pair_matrix
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.model import Model
from rbjax.spatial import RigidInertia


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
