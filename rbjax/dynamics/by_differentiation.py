"""Derivatives of dynamics by automatic differentiation, for joints whose axes depend on q.

`operands` has the formulas for axes that are fixed in their links. The axes of a `Node` are not.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from rbjax.dynamics.crba import mass_matrix
from rbjax.dynamics.forward import forward_dynamics, inverse_mass_matrix
from rbjax.dynamics.manifold import integrate
from rbjax.dynamics.rnea import inverse_dynamics
from rbjax.model import Model

Derivatives = tuple[jax.Array, jax.Array, jax.Array]


def differentiated_inverse(model: Model, q: jax.Array, v: jax.Array, a: jax.Array) -> Derivatives:
    """d ID / dq (tangent), d ID / dv, M, each (nv, nv)."""
    return (*_by_state(inverse_dynamics, model, q, v, a), mass_matrix(model, q))


def differentiated_forward(model: Model, q: jax.Array, v: jax.Array, tau: jax.Array) -> Derivatives:
    """d FD / dq (tangent), d FD / dv, M^-1, each (nv, nv)."""
    return (*_by_state(forward_dynamics, model, q, v, tau), inverse_mass_matrix(model, q))


def _by_state(
    f: Callable, model: Model, q: jax.Array, v: jax.Array, given: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """df/dq (tangent) and df/dv of f(model, q, v, given)."""

    def moved(dq: jax.Array, v: jax.Array) -> jax.Array:
        return f(model, integrate(model, q, dq), v, given)

    return jax.jacfwd(moved, (0, 1))(jnp.zeros_like(v), v)
