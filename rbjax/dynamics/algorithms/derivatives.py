"""First derivatives of inverse and forward dynamics.

    d tau = dID/dq dq + dID/dv dv + M da,      d a = M^-1 (d tau - dID/dq dq - dID/dv dv)

with dq in the tangent space of the configuration (`integrate`). An entry is a product of the
`operands` of two links. For forward dynamics M^-1 is applied to the columns with the factors of ABA
(inverse.py). On a GPU, a batch of a large robot is computed column by column (columns.py). If an
axis is not constant in its link (`Node`), JAX differentiates the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.display import displayed
from rbjax.dynamics.algorithms.aba import aba, acceleration, forward_dynamics
from rbjax.dynamics.algorithms.columns import forward_by_columns, inverse_by_columns
from rbjax.dynamics.algorithms.composites import (
    inverse_pairs,
    link_axes,
    tree_poses,
    whole_operands,
)
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.inverse import InverseMass, inverse_mass_matrix
from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.dynamics.algorithms.rnea import forces_at, inverse_dynamics
from rbjax.dynamics.drivers.choice import driver
from rbjax.dynamics.drivers.pairs import pair_matrix, with_armature
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.model import Model

Derivatives = tuple[jax.Array, jax.Array, jax.Array]


@displayed
class InverseDynamicsDerivatives(NamedTuple):
    """Derivatives (nv, nv) of tau with respect to q (tangent), v and a. The last is M."""

    q: jax.Array
    v: jax.Array
    a: jax.Array


@displayed
class ForwardDynamicsDerivatives(NamedTuple):
    """Derivatives (nv, nv) of a with respect to q (tangent), v and tau. The last is M^-1."""

    q: jax.Array
    v: jax.Array
    tau: jax.Array


def _inverse_in_kernels(model: Model, *given: jax.Array) -> tuple[jax.Array, ...]:
    by = inverse_by_columns if model.topology.constant_axes else differentiated_inverse
    return by(model, *given)


def _forward_in_kernels(model: Model, *given: jax.Array) -> tuple[jax.Array, ...]:
    by = forward_by_columns if model.topology.constant_axes else differentiated_forward
    return by(model, *given)


@algorithm("q", "v", "a", multi_kernel=_inverse_in_kernels)
def inverse_dynamics_derivatives(
    model: Model, q: ArrayLike, v: ArrayLike, a: ArrayLike
) -> InverseDynamicsDerivatives:
    """Differentiate `inverse_dynamics`, without force elements and constraints.

    Of tau = ID(q, v, a) it returns the derivatives (nv, nv) by q (tangent space), v and a.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        a: (nv,) acceleration.

    Returns:
        `InverseDynamicsDerivatives`, each (nv, nv), in SI units.

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
    if not model.topology.constant_axes:
        return InverseDynamicsDerivatives(*differentiated_inverse(model, q, v, a))
    d = driver(model, q.dtype)
    joints = d.joints(q, None)
    poses = tree_poses(d, joints)
    S = link_axes(d, poses, joints)
    x = whole_operands(d, poses, S, v, d.lanes(a))
    by_q, by_v, M = (pair_matrix(d, a, b, v) for a, b in inverse_pairs(S, x))
    return InverseDynamicsDerivatives(by_q, by_v, with_armature(d, M))


def bias_derivative(model: Model, q: jax.Array, v: jax.Array) -> jax.Array:
    """Compute the derivative (nv, nv) of the bias forces b(q, v) by v from checked arrays."""
    if not model.topology.constant_axes:

        def bias(v: jax.Array) -> jax.Array:
            return forces_at(model, q, v, jnp.zeros_like(v), {})

        return jax.jacfwd(bias)(v)
    d = driver(model, q.dtype)
    joints = d.joints(q, None)
    poses = tree_poses(d, joints)
    S = link_axes(d, poses, joints)
    x = whole_operands(d, poses, S, v, d.lanes(None))
    above, below = inverse_pairs(S, x)[1]
    return pair_matrix(d, above, below, v)


@algorithm("q", "v", "tau", pairs=True, multi_kernel=_forward_in_kernels)
def forward_dynamics_derivatives(
    model: Model, q: ArrayLike, v: ArrayLike, tau: ArrayLike
) -> ForwardDynamicsDerivatives:
    """Differentiate `forward_dynamics`, without force elements and constraints.

    Of a = FD(q, v, tau) it returns the derivatives (nv, nv) by q (tangent space), v and tau.
    `rb.linearise` differentiates the motion with everything in the model.

    Args:
        model: the robot.
        q: (nq,) configuration.
        v: (nv,) velocity.
        tau: (nv,) generalized force.

    Returns:
        `ForwardDynamicsDerivatives`, each (nv, nv), in SI units.

    Source: Carpentier & Mansard (2018); Singh, Russell & Wensing (2022), RA-L 7(2).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> s = model.default_state()
        >>> rb.forward_dynamics_derivatives(model, s.q, s.v, s.v).tau.shape
        (2, 2)
    """
    return accelerated_derivatives(model, q, v, tau)[1]


def accelerated_derivatives(
    model: Model, q: jax.Array, v: jax.Array, tau: jax.Array
) -> tuple[jax.Array, ForwardDynamicsDerivatives]:
    """Compute a = FD(q, v, tau) and its derivatives from checked arrays.
    If the joint axes are constant (`Topology.constant_axes`), both share one ABA."""
    if not model.nv:
        none = jnp.zeros((0, 0), q.dtype)
        return jnp.zeros(0, q.dtype), ForwardDynamicsDerivatives(none, none, none)
    if not model.topology.constant_axes:
        a = acceleration(model, q, v, tau)
        return a, ForwardDynamicsDerivatives(*differentiated_forward(model, q, v, tau))
    d = driver(model, q.dtype)
    joints = d.joints(q, v)
    a, factors = aba(d, joints, d.lanes(tau), d.prepared.gravity)
    _, _, U, inverse_D = d.unzip(factors, 4)
    poses = tree_poses(d, joints)
    S = link_axes(d, poses, joints)
    x = whole_operands(d, poses, S, v, a)
    by_q, by_v, inverse = InverseMass(d, poses, S, U, inverse_D, v)(*inverse_pairs(S, x)[:2])
    return d.pack(a, v), ForwardDynamicsDerivatives(by_q, by_v, inverse)


def differentiated_inverse(model: Model, q: jax.Array, v: jax.Array, a: jax.Array) -> Derivatives:
    """Compute dID/dq (tangent), dID/dv and M by differentiation with JAX, each (nv, nv)."""
    return (*_by_state(inverse_dynamics, model, q, v, a), mass_matrix(model, q))


def differentiated_forward(model: Model, q: jax.Array, v: jax.Array, tau: jax.Array) -> Derivatives:
    """Compute dFD/dq (tangent), dFD/dv and M^-1 by differentiation with JAX, each (nv, nv)."""
    return (*_by_state(forward_dynamics, model, q, v, tau), inverse_mass_matrix(model, q))


def _by_state(
    f: Callable, model: Model, q: jax.Array, v: jax.Array, given: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute df/dq (tangent) and df/dv of f(model, q, v, given) with JAX."""

    def moved(dq: jax.Array, v: jax.Array) -> jax.Array:
        return f(model, integrate(model, q, dq), v, given)

    return jax.jacfwd(moved, (0, 1))(jnp.zeros_like(v), v)
