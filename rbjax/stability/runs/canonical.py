"""Hamilton's equations of a robot, for solvers that are symplectic in (q, p).

    p = M(q) v,    q' = M^-1 p,    p' = dL/dq + Q,    L = v^T M v / 2 - U
Gauss' methods keep the symplectic form dq ^ dp of these coordinates, whatever the mass matrix. In
(q, v) they keep it only where M is constant; there, `rb.solvers.VariationalMidpoint` takes the
momentum along. (Hairer, Lubich & Wanner, *Geometric Numerical Integration*, VI.4.)
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax

from rbjax.dynamics import inverse_mass_matrix, kinetic_energy, mass_matrix, potential_energy
from rbjax.errors import InputError
from rbjax.forces import applied_forces
from rbjax.model import Model, State


class Hamiltonian(eqx.Module):
    """The vector field (t, (q, p), model) -> (q', p') of a robot without attitudes.

    Springs, dampers and no control act as in `simulate`.

    Raises:
        InputError: from `to_canonical`, for a model with quaternions.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, VI.1.

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("pendulum")
        >>> y = model.keyframe("horizontal").q, jax.numpy.ones(1)
        >>> [x.shape for x in jax.jit(rb.stability.Hamiltonian())(0.0, y, model)]
        [(1,), (1,)]
    """

    def __call__(self, t: Any, y: tuple[jax.Array, jax.Array], model: Model) -> Any:
        q, p = y
        v = (inverse_mass_matrix(model, q) * p).sum(-1)

        def lagrangian(q):
            return kinetic_energy(model, q, v) - potential_energy(model, q)

        return v, jax.grad(lagrangian)(q) + applied_forces(model, State(q, v), t=t)


def to_canonical(model: Model, state: State) -> tuple[jax.Array, jax.Array]:
    """(q, p) with p = M(q) v, of a robot whose configurations add (no ball or free joints).

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))`.

    Raises:
        InputError: the model has quaternions.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> q, p = rb.stability.to_canonical(model, model.default_state())
    """
    if model.topology.quaternion_starts:
        raise InputError(
            "to_canonical: got a model with quaternions, expected hinges and slides alone; "
            "simulate it with rb.solvers.VariationalMidpoint, which is symplectic on its manifold"
        )
    return state.q, (mass_matrix(model, state.q) * state.v).sum(-1)


def from_canonical(model: Model, y: tuple[jax.Array, jax.Array]) -> State:
    """The state of (q, p).

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("pendulum")
        >>> rb.stability.from_canonical(model, (jnp.zeros(1), jnp.ones(1))).v.shape
        (1,)
    """
    q, p = y
    return State(q, (inverse_mass_matrix(model, q) * p).sum(-1))
