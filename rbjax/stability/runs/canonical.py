"""Hamilton's equations of a robot, for solvers that are symplectic in (q, p).

    p = M(q) v,    q' = M^-1 p,    p' = dL/dq + Q,    L = v^T M v / 2 - U
Gauss methods conserve the symplectic form dq ^ dp of these coordinates for any mass matrix. In
(q, v) they conserve it only if M is constant. In (q, v) use `rb.solvers.VariationalMidpoint`
instead, which uses the momentum. (Hairer, Lubich & Wanner, *Geometric Numerical Integration*,
VI.4.)
"""

from __future__ import annotations

from typing import Any

import equinox as eqx
import jax
import numpy as np

from rbjax.dynamics import inverse_mass_matrix, kinetic_energy, mass_matrix, potential_energy
from rbjax.dynamics.arguments import check_array, check_arrays, check_model
from rbjax.errors import InputError
from rbjax.forces import applied_forces
from rbjax.model import Model, State


class Hamiltonian(eqx.Module):
    """The vector field (t, (q, p), model) -> (q', p') of a robot without attitudes.

    Springs and dampers act as in `simulate`, without control.

    Raises:
        InputError: a model with quaternions, or with force elements that have states.

    Source: Hairer, Lubich & Wanner, *Geometric Numerical Integration*, VI.1.

    Example:
        >>> import rbjax as rb, jax
        >>> model = rb.load("pendulum")
        >>> y = model.keyframe("horizontal").q, jax.numpy.ones(1)
        >>> [x.shape for x in jax.jit(rb.stability.Hamiltonian())(0.0, y, model)]
        [(1,), (1,)]
    """

    def __call__(self, t: Any, y: tuple[jax.Array, jax.Array], model: Model) -> Any:
        q, v = _velocity("Hamiltonian", model, y)

        def lagrangian(q):
            return kinetic_energy(model, q, v) - potential_energy(model, q)

        return v, jax.grad(lagrangian)(q) + applied_forces(model, State(q, v), t=t)


def to_canonical(model: Model, state: State) -> tuple[jax.Array, jax.Array]:
    """Convert a state to (q, p), with p = M(q) v, of a robot without ball or free joints.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))`.

    Returns:
        q (nq,), m and rad, and p (nv,), N s and N m s.

    Raises:
        InputError: the model has quaternions, or force elements with states; wrong shapes or
            dtypes, or values that are not finite.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> q, p = rb.stability.to_canonical(model, model.default_state())
    """
    _check("to_canonical", model)
    x = getattr(state, "x", None)
    if x is not None:
        raise InputError(
            f"to_canonical: state.x has shape {np.shape(x)}, expected None: (q, p) has no "
            "states of force elements, and the model has none"
        )
    state = check_arrays("to_canonical", model, {"state": state})["state"]
    return state.q, (mass_matrix(model, state.q) * state.v).sum(-1)


def from_canonical(model: Model, y: tuple[jax.Array, jax.Array]) -> State:
    """Convert (q, p) to a state, with v = M(q)^-1 p.

    Args:
        model: the robot.
        y: q (nq,), m and rad, and p (nv,), N s and N m s.

    Returns:
        `State(q (nq,), v (nv,))`, m/s and rad/s.

    Raises:
        InputError: as `to_canonical`.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("pendulum")
        >>> rb.stability.from_canonical(model, (jnp.zeros(1), jnp.ones(1))).v.shape
        (1,)
    """
    return State(*_velocity("from_canonical", model, y))


def _velocity(where: str, model: Model, y: Any) -> tuple[jax.Array, jax.Array]:
    """Return q, and v from the momentum p."""
    _check(where, model)
    if not (isinstance(y, tuple | list) and len(y) == 2):
        raise InputError(f"{where}: y is {type(y).__name__}, expected a pair (q (nq,), p (nv,))")
    q = check_arrays(where, model, {"q": y[0]})["q"]
    p = check_array(where, "p", y[1], (model.nv,))
    return q, (inverse_mass_matrix(model, q) * p).sum(-1)


def _check(where: str, model: Model) -> None:
    """Raise InputError for a model whose state is not (q, p)."""
    check_model(where, model)
    if model.topology.quaternion_starts:
        raise InputError(
            f"{where}: got a model with quaternions, expected only hinges and slides; "
            "simulate it with rb.solvers.VariationalMidpoint, which is symplectic on its manifold"
        )
    if model.nx:
        names = ", ".join(type(element).__name__ for element in model.forces if element.size)
        raise InputError(
            f"{where}: got a model with force elements that have states ({names}), expected none: "
            "(q, p) does not contain them; remove these elements with model.replace(forces=...), "
            "or use rb.simulate, which integrates them with q and v"
        )
