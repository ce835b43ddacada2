"""The coefficients of Lagrange's equations, term by term.

    tau_i = sum_j D_ij a_j + sum_jk D_ijk v_j v_k + D_i

The Coriolis matrix is linear in v, so its values at the unit velocities give all D_ijk.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics.algorithms.coriolis import coriolis_matrix
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.rnea import gravity_forces
from rbjax.dynamics.arguments import check_arrays
from rbjax.model import Model


class LagrangeCoefficients(NamedTuple):
    """The coefficients of `tau = D a + v^T H v + g` at a configuration.

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
