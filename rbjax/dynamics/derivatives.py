"""First derivatives of inverse and forward dynamics.

    d tau = dID/dq dq + dID/dv dv + M da,      d a = M^-1 (d tau - dID/dq dq - dID/dv dv)
with dq on the tangent space of the configuration (`integrate`). Forward mode through RNEA, nv
tangents side by side: O(nv^2) (Carpentier & Mansard, *Analytical derivatives*, RSS 2018).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import algorithm
from rbjax.dynamics.crba import mass_matrix
from rbjax.dynamics.forward import forward_dynamics, inverse_mass_matrix
from rbjax.dynamics.manifold import integrate
from rbjax.dynamics.rnea import inverse_dynamics
from rbjax.model import Model


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


def _partials(model: Model, q: jax.Array, v: jax.Array, a: jax.Array):
    def forces(dq, dv):
        return inverse_dynamics(model, integrate(model, q, dq), v + dv, a)

    zero = jnp.zeros(model.nv, q.dtype)
    return jax.jacfwd(forces, (0, 1))(zero, zero)


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
    by_q, by_v = _partials(model, q, v, a)
    return InverseDynamicsDerivatives(by_q, by_v, mass_matrix(model, q))


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
    a = forward_dynamics(model, q, v, tau)
    by_q, by_v = _partials(model, q, v, a)
    inverse = inverse_mass_matrix(model, q)

    def solve(columns):
        return -(inverse[:, :, None] * columns[None, :, :]).sum(1)

    return ForwardDynamicsDerivatives(solve(by_q), solve(by_v), inverse)
