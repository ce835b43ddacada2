"""Feedback controllers: functions of time and state that return forces and controls of actuators.

    tau_a = tau(t, x),      u = B^+ (tau_a - b)             (`allocation`)

tau_a are the forces of the actuators, in addition to all other forces on the model. A reference is
a constant, or a function of time, which JAX differentiates in forward mode:

    configuration   v = d/ds (q(t + s) - q(t)),  a = dv/dt         (difference on the manifold)
    frame           w = vee(R' R^T),  V = [w; p'],  A = [w'; p'']  in world axes
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.control.laws.allocation import Allocation, allocate, check_driven
from rbjax.dynamics.algorithms.manifold import difference
from rbjax.dynamics.algorithms.rnea import inverse_dynamics
from rbjax.dynamics.arguments import (
    check_array,
    check_model,
    check_moves,
    check_quaternions,
    check_takes,
)
from rbjax.errors import InputError
from rbjax.forces import applied_forces
from rbjax.kinematics.arguments import check_not_negative
from rbjax.model import Model, State
from rbjax.model.record import Record


class Followed(NamedTuple):
    """A reference at a time: configuration q (nq,), velocity v (nv,) and acceleration a (nv,)."""

    q: jax.Array
    v: jax.Array
    a: jax.Array


class PoseReference(NamedTuple):
    """A frame's reference at a time, in world axes, angular first.

    R: attitude, (3, 3).
    p: position, (3,).
    V: twist, (6,).
    A: time derivative of the twist, (6,).
    """

    R: jax.Array
    p: jax.Array
    V: jax.Array
    A: jax.Array


def check_configurations(where: str, model: Model, reference: Any, name: str = "reference") -> Any:
    """Check a reference of configurations: (nq,), a function t -> (nq,), or t -> (q, v, a)."""
    if callable(reference):
        check_takes(where, name, reference, "t")
        return reference
    q = check_array(where, name, reference, (model.nq,), fix=" or a function of t")
    check_quaternions(where, name, model, q)
    return q


def configuration(model: Model, reference: Any, t: Any, dtype: Any) -> Followed:
    """Evaluate the configuration, velocity and acceleration of a reference at a time."""
    if not callable(reference):
        still = jnp.zeros(model.nv, dtype)
        return Followed(reference.astype(dtype), still, still)
    t = jnp.asarray(t, dtype)
    found = reference(t)
    if isinstance(found, tuple):
        return Followed(*(jnp.asarray(x, dtype) for x in found))
    _sized("reference(t)", found, (model.nq,))

    def velocity(t: jax.Array) -> jax.Array:
        q = reference(t).astype(dtype)
        return _rate(lambda s: difference(model, q, reference(s).astype(dtype)), t)

    v, a = jax.jvp(velocity, (t,), (jnp.ones_like(t),))
    return Followed(jnp.asarray(found, dtype), v, a)


def check_poses(where: str, reference: Any, rows: tuple[str, ...]) -> Any:
    """Check the reference of a frame: an array, or a function of t.

    rows: the parts of the pose that it defines, "rotation" or "position" or both.
    """
    if isinstance(reference, Callable):  # type: ignore[arg-type]
        check_takes(where, "reference", reference, "t")
        return reference
    if rows == ("position",):
        return check_array(where, "reference", reference, (3,), fix=" or a function of t")
    if rows == ("rotation",):
        return check_array(where, "reference", reference, (3, 3), fix=" or a function of t")
    if not isinstance(reference, tuple) or len(reference) != 2:
        raise InputError(
            f"{where}: reference is {type(reference).__name__}, expected a pair (R (3, 3), p (3,)) "
            "or a function of t that returns one"
        )
    R, p = reference
    return check_array(where, "reference[0]", R, (3, 3)), check_array(
        where, "reference[1]", p, (3,)
    )


def pose(reference: Any, t: Any, rows: tuple[str, ...], dtype: Any) -> PoseReference:
    """Evaluate the pose, twist and acceleration of a reference at time t.

    rows: the parts of the pose that it defines. The other part is the identity or zero.
    """
    t = jnp.asarray(t, dtype)

    def at(t: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = reference(t) if callable(reference) else reference
        if rows == ("position",):
            R, p = jnp.eye(3, dtype=dtype), found
        elif rows == ("rotation",):
            R, p = found, jnp.zeros(3, dtype)
        else:
            R, p = found
        R, p = jnp.asarray(R, dtype), jnp.asarray(p, dtype)
        _sized("reference(t)", R, (3, 3))
        _sized("reference(t)", p, (3,))
        return R, p

    R, p = at(t)
    if not callable(reference):
        return PoseReference(R, p, jnp.zeros(6, dtype), jnp.zeros(6, dtype))

    def twist(t: jax.Array) -> jax.Array:
        (R, _), (R_rate, p_rate) = jax.jvp(at, (t,), (jnp.ones_like(t),))
        W = (R_rate[:, None, :] * R[None, :, :]).sum(-1)
        w = jnp.stack([W[2, 1] - W[1, 2], W[0, 2] - W[2, 0], W[1, 0] - W[0, 1]]) / 2
        return jnp.concatenate([w, p_rate])

    V, A = jax.jvp(twist, (t,), (jnp.ones_like(t),))
    return PoseReference(R, p, V, A)


def _rate(f: Callable, t: jax.Array) -> jax.Array:
    return jax.jvp(f, (t,), (jnp.ones_like(t),))[1]


def _sized(name: str, x: Any, shape: tuple[int, ...]) -> None:
    if jnp.shape(x) != shape:
        raise InputError(f"{name} has shape {jnp.shape(x)}, expected {shape}")


class Controller(Record):
    """A policy (t, state) -> ctrl of a model. Its gains and the model are leaves of a pytree.

    controller(t, state): controls (nu,), within their ranges.
    controller.tau(t, state): desired generalized forces (nv,) of the actuators.
    controller.allocated(t, state): controls, and the forces that the actuators cannot produce.
    """

    model: Model
    undriven: str = eqx.field(static=True)

    def __hash__(self) -> int:
        return id(self)  # `jax.jit(controller)` caches functions by identity

    @abc.abstractmethod
    def tau(self, t: Any, state: State) -> jax.Array:
        """Return the desired generalized forces (nv,) of the actuators, N m or N."""

    def __call__(self, t: Any, state: State) -> jax.Array:
        """Return the controls (nu,), within their ranges."""
        return self.allocated(t, state).ctrl

    def allocated(self, t: Any, state: State) -> Allocation:
        """Return the controls, and the residual forces (nv,) that the actuators cannot produce."""
        return allocate(self.model, state, self.tau(t, state))


#: options for the forces that an impedance compensates
COMPENSATE = ("rest", "motion")


def check_controlled_model(where: str, model: Any, undriven: str) -> None:
    """Raise InputError for constraints, and for undriven dofs if `undriven` is "refuse"."""
    check_model(where, model)
    check_moves(where, model)
    if model.constraints:
        raise InputError(
            f"{where}: the model has {len(model.constraints)} constraints, whose forces this law "
            "does not know; expected a tree: model.replace(constraints=())"
        )
    if model.nu:
        check_driven(where, model, undriven)


def gains(where: str, name: str, value: Any, n: int) -> jax.Array:
    """Return a gain (n,) from a number or (n,). Raise InputError if one is negative."""
    return jnp.broadcast_to(check_not_negative(where, name, value, (), (n,)), (n,))


def actuator_forces(model: Model, state: State, a: jax.Array) -> jax.Array:
    """Return the actuator forces (nv,) for the accelerations a, by inverse dynamics: M a + b -
    other forces."""
    return inverse_dynamics(model, state.q, state.v, a) - applied_forces(model, state, None)


def holding_forces(model: Model, state: State) -> jax.Array:
    """Return the actuator forces (nv,) that keep the robot at rest in this configuration."""
    still = State(state.q, jnp.zeros_like(state.v), state.x)
    return actuator_forces(model, still, still.v)


def balancing_forces(model: Model, state: State, compensate: str) -> jax.Array:
    """Return the forces h (nv,) that an impedance compensates: at rest or in motion."""
    if compensate == "rest":
        return holding_forces(model, state)
    return actuator_forces(model, state, jnp.zeros_like(state.v))
