"""One step of a motion, and a motion linearised about a state.

    d/dt dx = A dx + B du,     dx = [dq; dv; dx_e],     A = [[-[w]x, 1, 0], [a_q, a_v, a_x], [..]]
    dx+ = A dx + B du          where a step dt is given
with dq on the tangent space of the configuration (body axes for attitudes, hence -[w]x) and x_e the
states of force elements.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.constraints.formulation import Formulation
from rbjax.dynamics.algorithms.derivatives import accelerated_derivatives
from rbjax.dynamics.algorithms.manifold import difference, integrate
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.forces.acting import applied
from rbjax.forces.context import Context
from rbjax.forces.inputs import Inputs
from rbjax.lanes.arrays import matmat
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.field import Dynamics, Field, dynamics_of, free_motion
from rbjax.motion.force_jacobian import by_joint, times_jacobian
from rbjax.motion.integrators import Integrator, advanced, integrator_of, semi_implicit_euler


class Linear(Record):
    """A linearisation, with n = 2 nv + nx. `A, B = linearise(...)` unpacks the matrices.

    A: (n, n).
    B: (n, nu).
    acceleration: (nv,) v' at the point; with dt, the mean of v' over the step. It is zero if the
        controls hold the robot at rest there.
    """

    A: jax.Array
    B: jax.Array
    acceleration: jax.Array

    def __iter__(self) -> Iterator[jax.Array]:
        return iter((self.A, self.B))


@algorithm("state", "ctrl", "dt", "t")
def step(
    model: Model,
    state: State,
    ctrl: jax.Array | None = None,
    dt: Any = None,
    *,
    t: Any = 0.0,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics = free_motion,
    constraints: str | Formulation | None = None,
) -> State:
    """The state after one step, the controls held over it: what `rollout` does once.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))`, with x (nx,) where force elements have states.
        ctrl: (nu,) controls; None for no actuation.
        dt: step in seconds; the model's timestep if None.
        t: time in seconds, for force elements that look at it.
        integrator: as in `rollout`.
        dynamics: from forces to accelerations (`rbjax.motion.field.Dynamics`).
        constraints: how those of the model are enforced: a name of `rbjax.constraints.formulations`
            or a `Formulation`; None for "projected", as `rbjax.recommend.formulation(model)`.

    Returns:
        `State`.

    Raises:
        InputError: shapes, dtypes, values that are not finite, an unknown integrator, a step that
            is not positive.

    Source: as `rollout`.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("cart_pole")
        >>> rb.step(model, model.default_state(), dt=0.01).q.shape
        (2,)
    """
    dt = jnp.asarray(model.timestep, state.q.dtype) if dt is None else dt
    dynamics = dynamics_of("step", model, dynamics, constraints)
    integrator = integrator_of("step", integrator, dynamics)
    return advanced(integrator, Field(model, dynamics, dt), t, state, Inputs(ctrl), dt)


@algorithm("state", "ctrl", "dt", "t", pairs=True)
def linearise(
    model: Model,
    state: State,
    ctrl: jax.Array | None = None,
    dt: Any = None,
    *,
    t: Any = 0.0,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics = free_motion,
    constraints: str | Formulation | None = None,
) -> Linear:
    """A and B of the motion linearised about a state and controls, with all forces that act.

    d/dt dx = A dx + B du; with a step dt: dx+ = A dx + B du, the derivative of `rb.step`.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))` about which to linearise; x (nx,) with it.
        ctrl: (nu,) controls; None for no actuation, then B has no columns.
        dt: step in seconds of the discrete form; None for the continuous one.
        t: time in seconds, for force elements that look at it.
        integrator: of the discrete form, as in `rollout`.
        dynamics: from forces to accelerations (`rbjax.motion.field.Dynamics`).
        constraints: how those of the model are enforced: a name of `rbjax.constraints.formulations`
            or a `Formulation`; None for "projected", as `rbjax.recommend.formulation(model)`.

    Returns:
        `Linear` with A (n, n), B (n, nu) and the acceleration (nv,) at the point, n = 2 nv + nx;
        rows and columns are dq on the tangent space, in the coordinates of v, then dv, then the
        states of force elements.

    Raises:
        InputError: shapes, dtypes, values that are not finite, an unknown integrator, a step that
            is not positive.

    Source: Carpentier & Mansard, *Analytical derivatives of rigid body dynamics*, RSS 2018.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> A, B = rb.linearise(model, model.default_state(), jnp.zeros(1))
        >>> A.shape, B.shape
        ((4, 4), (4, 1))
    """
    dynamics = dynamics_of("linearise", model, dynamics, constraints)
    if dt is None:
        rates, A, B = linearised(model, state, ctrl, t, dynamics)
        return Linear(A, B, rates[: model.nv])
    integrator = integrator_of("linearise", integrator, dynamics)
    u = jnp.zeros(0, state.q.dtype) if ctrl is None else ctrl
    if integrator is semi_implicit_euler and dynamics is free_motion and ctrl is not None:
        found = euler_linearised(model, t, state, ctrl, dt)
        if found is not None:
            after, A, B = found
            return Linear(A, B, (after.v - state.v) / dt)
    advance = functools.partial(advanced, integrator)
    field = Field(model, dynamics, dt)
    after = advance(field, t, state, Inputs(ctrl), dt)

    def moved(dx: jax.Array, du: jax.Array) -> jax.Array:
        inputs = Inputs(None if ctrl is None else ctrl + du)
        new = advance(field, t, box_plus(model, state, dx), inputs, dt)
        return box_minus(model, after, new)

    n = 2 * model.nv + model.nx
    A, B = jax.jacfwd(moved, (0, 1))(jnp.zeros(n, u.dtype), jnp.zeros_like(u))
    return Linear(A, B, (after.v - state.v) / dt)


def linearised(
    model: Model, state: State, ctrl: Any, t: Any = 0.0, dynamics: Dynamics = free_motion
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The rates (nv + nx,) of v and of the elements' states, A and B of the continuous form."""
    n, dtype = model.nv, state.q.dtype
    u = jnp.zeros(0, dtype) if ctrl is None else ctrl
    find = _free_rates if dynamics is free_motion and n else _rates
    found, lower, B = find(model, state, ctrl, u, t, dynamics)
    turning = jnp.zeros((n, n), dtype)
    for at in model.topology.turn_starts:
        rows = slice(at, at + 3)
        turning = turning.at[rows, rows].set(-jnp.cross(state.v[rows], jnp.eye(3, dtype=dtype)).T)
    upper = [turning, jnp.eye(n, dtype=dtype), jnp.zeros((n, model.nx), dtype)]
    A = jnp.concatenate([jnp.concatenate(upper, 1), lower])
    return found, A, jnp.concatenate([jnp.zeros((n, u.shape[0]), dtype), B])


def _rates(
    model: Model, state: State, ctrl: Any, u: jax.Array, t: Any, dynamics: Dynamics
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """The rates (nv + nx,), and their derivatives by dx and by du, of any dynamics."""

    def rates(dx: jax.Array, du: jax.Array) -> tuple[jax.Array, jax.Array]:
        inputs = Inputs(None if ctrl is None else ctrl + du)
        a, x = Field(model, dynamics).rates(t, box_plus(model, state, dx), inputs)
        found = a if x is None else jnp.concatenate([a, x])
        return found, found

    start = jnp.zeros(2 * model.nv + model.nx, state.q.dtype)
    (by_x, by_u), found = jax.jacfwd(rates, (0, 1), has_aux=True)(start, jnp.zeros_like(u))
    return found, by_x, by_u


def _free_rates(
    model: Model, state: State, ctrl: Any, u: jax.Array, t: Any, dynamics: Dynamics
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """`_rates` of free motion, by the closed form of the derivatives of forward dynamics, which
    compiles in a tenth of the time of one tangent for each column."""
    n = model.nv

    def forces(dx: jax.Array, du: jax.Array) -> tuple[jax.Array, jax.Array]:
        inputs = Inputs(None if ctrl is None else ctrl + du)
        tau, x = generalized_forces(model, t, box_plus(model, state, dx), inputs)
        found = tau if x is None else jnp.concatenate([tau, x])
        return found, found

    start = jnp.zeros(2 * n + model.nx, state.q.dtype)
    if by_joint(model):
        tau = forces(start, jnp.zeros_like(u))[0]
        a, by = accelerated_derivatives(model, state.q, state.v, tau)
        a_x, a_u = times_jacobian(model, lambda *x: forces(*x)[0], u.shape[0], by.tau)
        return a, a_x + jnp.concatenate([by.q, by.v], 1), a_u
    (F_x, F_u), F = jax.jacfwd(forces, (0, 1), has_aux=True)(start, jnp.zeros_like(u))
    a, by = accelerated_derivatives(model, state.q, state.v, F[:n])
    a_x = matmat(by.tau, F_x[:n]).at[:, : 2 * n].add(jnp.concatenate([by.q, by.v], 1))
    a_u = matmat(by.tau, F_u[:n])
    return tuple(jnp.concatenate(x) for x in ((a, F[n:]), (a_x, F_x[n:]), (a_u, F_u[n:])))  # type: ignore[return-value]


def generalized_forces(
    model: Model, t: Any, state: State, inputs: Inputs, dt: Any = None
) -> tuple[jax.Array, jax.Array | None]:
    """All forces that act, as generalized forces (nv,), and x' (nx,)."""
    tau, f_ext, x = applied(model, t, state, inputs, dt)
    if f_ext:
        tau = tau + Context.of(model, t, state, None).generalized_of(f_ext)
    return tau, x


def box_plus(model: Model, state: State, dx: jax.Array) -> State:
    """The state moved by dx = [dq; dv; dx_e]."""
    n = model.nv
    x = None if state.x is None else state.x + dx[2 * n :]
    return State(integrate(model, state.q, dx[:n]), state.v + dx[n : 2 * n], x)


def box_minus(model: Model, one: State, other: State) -> jax.Array:
    """dx from one state to another."""
    dx = [difference(model, one.q, other.q), other.v - one.v]
    if one.x is not None and other.x is not None:
        dx.append(other.x - one.x)
    return jnp.concatenate(dx)


def euler_linearised(
    model: Model, t: Any, state: State, ctrl: jax.Array, dt: Any
) -> tuple[State, jax.Array, jax.Array] | None:
    """The state after a semi-implicit Euler step of free motion, A and B, by the closed form of
    the derivatives of forward dynamics; None where elements have states.

    dv+ = dv + dt da,   dq+ = E dq + dt J dv+,   da = a_q dq + a_v dv + M^-1 dtau
    """
    if model.nx or not model.nv:
        return None
    n, dtype = model.nv, state.q.dtype

    def forces(dx: jax.Array, du: jax.Array) -> jax.Array:
        inputs = Inputs(ctrl + du)
        return generalized_forces(model, t, box_plus(model, state, dx), inputs, dt)[0]

    tau = forces(jnp.zeros(2 * n, dtype), jnp.zeros_like(ctrl))
    a, by = accelerated_derivatives(model, state.q, state.v, tau)
    v = state.v + dt * a
    q = integrate(model, state.q, dt * v)
    direct = jnp.concatenate([by.q, by.v], 1)
    a_x, a_u = times_jacobian(model, forces, ctrl.shape[0], by.tau)
    a_x = direct + a_x
    v_x = dt * a_x + jnp.eye(n, 2 * n, n, dtype=dtype)
    if model.topology.turn_starts:

        def turned(dq: jax.Array, dv: jax.Array) -> jax.Array:
            moved = integrate(model, integrate(model, state.q, dq), dt * (v + dv))
            return difference(model, q, moved)

        still = jnp.zeros(n, dtype)
        E, J = jax.jacfwd(turned, (0, 1))(still, still)
        q_x = matmat(J, v_x).at[:, :n].add(E)
        q_u = dt * matmat(J, a_u)
    else:
        q_x = dt * v_x + jnp.eye(n, 2 * n, dtype=dtype)
        q_u = dt * dt * a_u
    return State(q, v, state.x), jnp.concatenate([q_x, v_x]), jnp.concatenate([q_u, dt * a_u])
