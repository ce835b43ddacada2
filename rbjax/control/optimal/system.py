"""Dynamical systems of optimal control: states on a manifold, and a discrete step.

    x+ = f(t, x, u, dt),      x (+) dx,      dx = y (-) x,      A = df/dx, B = df/du (tangent)

The methods of `solve` use only this interface. A system is a `Model`, a function of a vector
(`Equations`), or an object whose type is registered with `as_system.register` (robots of
`rbjax.wheeled`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.arguments import flag, floating_array, instance, integer
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_takes
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.field import Field, dynamics_of, free_motion
from rbjax.motion.integrators import advance_state, integrator_of, semi_implicit_euler
from rbjax.motion.linearise import box_minus, box_plus, linearise_euler_step


@displayed
class LinearisedStep(NamedTuple):
    """The state after a step, and its derivatives A (n, n) and B (n, m) on the tangent space."""

    after: Any
    A: jax.Array
    B: jax.Array


class System(Record):
    """A dynamical system: states on a manifold, and a step. Subclasses are final. `model` is the
    `model` argument of costs and constraints: the robot itself."""

    @property
    def model(self) -> Any:
        """The `model` argument of costs and constraints."""
        return self

    def with_model(self, model: Any) -> System:
        """Return the same system with another model."""
        raise NotImplementedError(f"{type(self).__name__} has no method with_model")

    @property
    def n(self) -> int:
        """The dimension of the tangent space of states."""
        raise NotImplementedError(f"{type(self).__name__} has no property n")

    @property
    def nu(self) -> int:
        """The number of controls."""
        raise NotImplementedError(f"{type(self).__name__} has no property nu")

    @property
    def ctrl_range(self) -> tuple[Any, Any]:
        """The smallest and the largest valid controls, (nu,) each."""
        return jnp.full(self.nu, -jnp.inf), jnp.full(self.nu, jnp.inf)

    @property
    def touches(self) -> bool:
        """True if the system has contacts that open and close."""
        return False

    @property
    def by_velocities(self) -> bool:
        """True if a step is dq+ = dq + dt dv+ on the tangent space (dq, dv)."""
        return False

    def spans(self) -> list[slice]:
        """Return, for each leaf of a state, the tangent coordinates on which the leaf depends."""
        leaves = jax.tree.leaves(self.example(jnp.zeros(()).dtype))
        return [slice(0, self.n)] * len(leaves)

    def checked(self, where: str, state: Any) -> Any:
        """Convert a state to the form that `step` requires; raise InputError if that fails."""
        raise NotImplementedError(f"{type(self).__name__} has no method checked")

    def example(self, dtype: Any) -> Any:
        """Return a state with the right shapes; its values are arbitrary."""
        raise NotImplementedError(f"{type(self).__name__} has no method example")

    def step(self, t: Any, state: Any, ctrl: jax.Array, dt: Any) -> Any:
        """Return the state after dt under constant controls."""
        raise NotImplementedError(f"{type(self).__name__} has no method step")

    def plus(self, state: Any, dx: jax.Array) -> Any:
        """Return state (+) dx."""
        raise NotImplementedError(f"{type(self).__name__} has no method plus")

    def minus(self, one: Any, other: Any) -> jax.Array:
        """Return dx (n,) from `other` to `one`: other (+) dx = one."""
        raise NotImplementedError(f"{type(self).__name__} has no method minus")

    def rates(self, t: Any, base: Any, dx: jax.Array, ctrl: jax.Array) -> jax.Array:
        """Return dx' (n,) of the motion base (+) dx in continuous time, for collocation."""
        raise InputError(
            f"{type(self).__name__} has steps only, and collocation needs rates in continuous "
            "time; take another method, such as 'ddp', or write the rates as rb.control.Equations"
        )

    def linear(self, t: Any, state: Any, ctrl: jax.Array, dt: Any) -> LinearisedStep:
        """Return the step and its derivatives, by forward differentiation of `step`."""
        after = self.step(t, state, ctrl, dt)

        def moved(dx: jax.Array, du: jax.Array) -> jax.Array:
            return self.minus(self.step(t, self.plus(state, dx), ctrl + du, dt), after)

        zero = jnp.zeros(self.n, ctrl.dtype)
        A, B = jax.jacfwd(moved, (0, 1))(zero, jnp.zeros_like(ctrl))
        return LinearisedStep(after, A, B)


class ModelSystem(System):
    """A `Model` with an integrator and dynamics.

    robot: the model, with unlimited actuators; the optimiser enforces the control ranges, since
        clipping would make derivatives zero at a bound.
    integrator, dynamics: as in `rb.rollout`.
    ranges: control ranges, (nu, 2).
    """

    robot: Model
    integrator: Any
    dynamics: Any
    ranges: jax.Array

    @property
    def model(self) -> Model:
        return self.robot

    def with_model(self, model: Model) -> ModelSystem:
        return ModelSystem(unlimited(model), self.integrator, self.dynamics, self.ranges)

    @property
    def n(self) -> int:
        return 2 * self.robot.nv + self.robot.nx

    @property
    def nu(self) -> int:
        return self.robot.nu

    @property
    def ctrl_range(self) -> tuple[Any, Any]:
        return self.ranges[:, 0], self.ranges[:, 1]

    def checked(self, where: str, state: Any) -> State:
        m = self.robot
        instance(where, "the state", state, State, f"rb.State(q ({m.nq},), v ({m.nv},))")
        q = jnp.asarray(state.q, float)
        x = m.start(q.dtype) if state.x is None else jnp.asarray(state.x, q.dtype)
        due = {"q": (q, m.nq), "v": (jnp.asarray(state.v, q.dtype), m.nv)}
        for name, (value, size) in due.items():
            if value.shape != (size,):
                raise InputError(
                    f"{where}: {name} of the state has shape {value.shape}, expected ({size},); "
                    "for a batch use jax.vmap"
                )
        return State(q, due["v"][0], x)

    def example(self, dtype: Any) -> State:
        m = self.robot
        x = m.start(dtype)
        return State(jnp.zeros(m.nq, dtype), jnp.zeros(m.nv, dtype), x)

    @property
    def touches(self) -> bool:
        return self.robot.contact is not None

    @property
    def by_velocities(self) -> bool:
        plain = self.integrator is semi_implicit_euler and self.dynamics is free_motion
        return plain and not self.robot.nx and not self.robot.topology.turn_starts

    def spans(self) -> list[slice]:
        nv, n = self.robot.nv, self.n
        return [slice(0, nv), slice(nv, 2 * nv), slice(2 * nv, n)][: 2 + (n > 2 * nv)]

    def step(self, t: Any, state: State, ctrl: jax.Array, dt: Any) -> State:
        field = Field(self.robot, self.dynamics, dt)
        return advance_state(self.integrator, field, t, state, Inputs(ctrl), dt)

    def rates(self, t: Any, base: State, dx: jax.Array, ctrl: jax.Array) -> jax.Array:
        field = Field(self.robot, self.dynamics)
        now = self.plus(base, dx)
        a, x = field.rates(t, now, Inputs(ctrl))
        turning = field.increment_rate(dx[: self.robot.nv], now.v)
        return jnp.concatenate([turning, a] if x is None else [turning, a, x])

    def plus(self, state: State, dx: jax.Array) -> State:
        return box_plus(self.robot, state, dx)

    def minus(self, one: State, other: State) -> jax.Array:
        return box_minus(self.robot, other, one)

    def linear(self, t: Any, state: State, ctrl: jax.Array, dt: Any) -> LinearisedStep:
        if self.integrator is semi_implicit_euler and self.dynamics is free_motion:
            found = linearise_euler_step(self.robot, t, state, Inputs(ctrl), dt)
            if found is not None:
                return LinearisedStep(*found)
        return super().linear(t, state, ctrl, dt)


class Equations(System):
    """A system from a function of a vector: x' = f(t, x, u) with RK4 steps, or x+ = f(t, x, u).

    function: f.
    size: length of x.
    controls: length of u.
    discrete: true if the function returns the next state.
    parts: number of Runge-Kutta steps of one step.
    """

    function: Callable[[Any, jax.Array, jax.Array], jax.Array]
    size: int = eqx.field(static=True)
    controls: int = eqx.field(static=True)
    discrete: bool = eqx.field(static=True, default=False)
    parts: int = eqx.field(static=True, default=1)

    def __check_init__(self) -> None:
        check_takes("Equations", "function", self.function, "t", "x", "u")
        for name in ("size", "controls", "parts"):
            integer("Equations", name, getattr(self, name), least=1)
        flag("Equations", "discrete", self.discrete)

    def with_model(self, model: Any) -> System:
        if not isinstance(model, System):
            raise InputError(f"a design gave {type(model).__name__}, expected Equations")
        return model

    @property
    def n(self) -> int:
        return self.size

    @property
    def nu(self) -> int:
        return self.controls

    def checked(self, where: str, state: Any) -> jax.Array:
        due = (self.size,)
        return floating_array(where, "the state", state, due.__eq__, str(due)).astype(float)

    def spans(self) -> list[slice]:
        return [slice(0, self.size)]

    def example(self, dtype: Any) -> jax.Array:
        return jnp.zeros(self.size, dtype)

    def step(self, t: Any, state: jax.Array, ctrl: jax.Array, dt: Any) -> jax.Array:
        if self.discrete:
            return self._value(t, state, ctrl)
        h = dt / self.parts
        for k in range(self.parts):
            state = self._rk4(t + k * h, state, ctrl, h)
        return state

    def rates(self, t: Any, base: jax.Array, dx: jax.Array, ctrl: jax.Array) -> jax.Array:
        if self.discrete:
            raise InputError(
                "Equations: discrete=True gives the next state, and collocation needs rates in "
                "continuous time; take another method, such as 'ddp'"
            )
        return self._value(t, base + dx, ctrl)

    def _rk4(self, t: Any, x: jax.Array, u: jax.Array, h: Any) -> jax.Array:
        k1 = self._value(t, x, u)
        k2 = self._value(t + h / 2, x + h / 2 * k1, u)
        k3 = self._value(t + h / 2, x + h / 2 * k2, u)
        k4 = self._value(t + h, x + h * k3, u)
        return x + h / 6 * (k1 + 2 * (k2 + k3) + k4)

    def _value(self, t: Any, x: jax.Array, u: jax.Array) -> jax.Array:
        value = jnp.asarray(self.function(t, x, u), x.dtype)
        if value.shape != (self.size,):
            raise InputError(
                f"Equations: the function returned shape {value.shape}, expected ({self.size},)"
            )
        return value

    def plus(self, state: jax.Array, dx: jax.Array) -> jax.Array:
        return state + dx

    def minus(self, one: jax.Array, other: jax.Array) -> jax.Array:
        return one - other


def unlimited(model: Model) -> Model:
    """Return the model with unlimited controls."""
    ends = jnp.asarray([-jnp.inf, jnp.inf])
    ranges = jnp.broadcast_to(ends, jnp.shape(model.actuators.ctrlrange))
    return model.replace(actuators=model.actuators.replace(ctrlrange=ranges))


@functools.singledispatch
def as_system(model: Any) -> System | None:
    """Return the `System` of an object, or None. `as_system.register` adds a type."""
    return model if isinstance(model, System) else None


def system_of(
    where: str,
    model: Any,
    integrator: Any = None,
    dynamics: Any = free_motion,
    constraints: Any = None,
) -> System:
    """Return the system of a model, or a system itself."""
    if isinstance(model, Model):
        dynamics = dynamics_of(where, model, dynamics, constraints)
        ranges = jnp.asarray(model.actuators.ctrlrange)
        return ModelSystem(
            unlimited(model), integrator_of(where, integrator, dynamics, model), dynamics, ranges
        )
    if integrator is not None or dynamics is not free_motion or constraints is not None:
        raise InputError(f"{where}: integrator, dynamics and constraints are for an rb.Model")
    system = as_system(model)
    if system is not None:
        return system
    raise InputError(
        f"{where}: got {type(model).__name__}, expected an rb.Model, rb.control.Equations(f, n, m) "
        "or a robot of rb.wheeled.at(...)"
    )
