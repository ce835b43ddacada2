"""Derivatives of dynamics by automatic differentiation, for joints whose axes depend on q.

`operands` has the formulas for axes that are fixed in their links. The axes of a `Node` are not.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.dynamics.crba import mass_matrix
from rbjax.dynamics.forward import forward_dynamics, inverse_mass_matrix
from rbjax.dynamics.manifold import integrate
from rbjax.dynamics.rnea import inverse_dynamics
from rbjax.model import Model


def differentiated_inverse(
    model: Model, q: jax.Array, v: jax.Array, a: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """d ID / dq (tangent), d ID / dv, M, each (nv, nv)."""

    def tau(dq: jax.Array, v: jax.Array) -> jax.Array:
        return inverse_dynamics(model, integrate(model, q, dq), v, a)

    by_q, by_v = jax.jacfwd(tau, (0, 1))(jnp.zeros_like(v), v)
    return by_q, by_v, mass_matrix(model, q)


def differentiated_forward(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """d FD / dq (tangent), d FD / dv, M^-1, each (nv, nv)."""

    def a(dq: jax.Array, v: jax.Array) -> jax.Array:
        return forward_dynamics(model, integrate(model, q, dq), v, tau)

    by_q, by_v = jax.jacfwd(a, (0, 1))(jnp.zeros_like(v), v)
    return by_q, by_v, inverse_mass_matrix(model, q)
