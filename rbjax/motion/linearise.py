"""Linearisation of the motion of a robot about a state.

    d/dt dx = A dx + B du,     dx = [dq; dv; dx_e],     A = [[-[w]x, 1, 0], [a_q, a_v, a_x], [..]]
    dx+ = A dx + B du          with a step dt
dq is in the tangent space of the configuration (body axes for attitudes, hence -[w]x), and x_e are
the states of force elements.

If all elements are springs, dampers and actuators of joints, a force depends only on its own joint.
The Jacobian is then block diagonal, and one tangent gives a column of all blocks (Curtis, Powell &
Reid 1974): a chain of 40 hinges needs 3 tangents instead of 120.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.constraints.formulation import Formulation
from rbjax.dynamics.algorithms.derivatives import accelerated_derivatives
from rbjax.dynamics.algorithms.manifold import difference, integrate
from rbjax.dynamics.drivers.choice import CPU_UNROLLED_UP_TO
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.forces.acting import applied
from rbjax.forces.context import Context
from rbjax.forces.inputs import Inputs, Source, evaluated
from rbjax.lanes.arrays import matmat
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.field import (
    Dynamics,
    Field,
    VelocityDynamics,
    dynamics_of,
    free_motion,
    with_contact,
)
from rbjax.motion.integrators import Integrator, advance_state, integrator_of, semi_implicit_euler
from rbjax.motion.step import with_memory


class Linear(Record):
    """A linearisation, with n = 2 nv + nx. `A, B = linearise(...)` unpacks the matrices.

    A: (n, n) derivative by the state.
    B: (n, nu) derivative by the controls.
    acceleration: (nv,) v' at the point, or with dt the mean of v' over the step. It is zero if
        the controls hold the robot at rest.
    """

    A: jax.Array
    B: jax.Array
    acceleration: jax.Array

    def __iter__(self) -> Iterator[jax.Array]:
        return iter((self.A, self.B))


@algorithm(
    "state", "ctrl", "dt", "tau", "wrenches", "t", pairs=True,
    functions=("ctrl", "tau", "wrenches"),
)  # fmt: skip
def linearise(
    model: Model,
    state: State,
    ctrl: ArrayLike | Source | None = None,
    dt: Any = None,
    *,
    tau: ArrayLike | Source | None = None,
    wrenches: ArrayLike | Source | None = None,
    t: Any = 0.0,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics | VelocityDynamics = free_motion,
    constraints: str | Formulation | None = None,
    contact: Any = None,
) -> Linear:
    """Linearise the motion about a state and controls, with all forces that act on the model.

    Without dt: d/dt dx = A dx + B du. With a step dt: dx+ = A dx + B du, the derivative of `step`.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))` about which to linearise, with x (nx,) if force elements
            have states.
        ctrl: controls (nu,). None: no actuation, and B has no columns. A policy
            (t, state) -> (nu,): A is of the closed loop, and du is added to the controls.
        dt: step in s of the discrete form; None for the continuous form.
        tau: generalized forces (nv,) in addition to those of the model, or a function (t, state).
        wrenches: (nb, 6) [moment N m; force N] on bodies, in world axes at their origins, or a
            function (t, state).
        t: time in s, for force elements that depend on it.
        integrator: integrator of the discrete form, as in `rollout`.
        dynamics: map from forces to accelerations (`rbjax.motion.field.Dynamics`); in the discrete
            form also to the velocity after the step (`VelocityDynamics`).
        constraints: how to enforce the constraints of the model: a name of
            `rbjax.constraints.formulations`, a `Formulation`, or None for "projected".
        contact: law of contact between the geoms of the model, a name of `rbjax.contact.laws`; None
            for the law of the model (`load(contacts=True)`).

    Returns:
        `Linear` with A (n, n), B (n, nu) and the acceleration (nv,) at the point, n = 2 nv + nx.
        Rows and columns are dq in the tangent space, in the coordinates of v, then dv, then the
        states of force elements.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite, an unknown integrator, a
            step that is not positive.

    Source: Carpentier & Mansard, *Analytical derivatives of rigid body dynamics*, RSS 2018.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("cart_pole")
        >>> A, B = rb.linearise(model, model.default_state(), jnp.zeros(1))
        >>> A.shape, B.shape
        ((4, 4), (4, 1))
    """
    dynamics = with_contact("linearise", model, dynamics, contact)
    dynamics = dynamics_of("linearise", model, dynamics, constraints, steps=dt is not None)
    given = Inputs(ctrl, tau, wrenches)
    if dt is None:
        rates, A, B = linearise_rates(model, state, given, t, dynamics)
        return Linear(A, B, rates[: model.nv])
    integrator = integrator_of("linearise", integrator, dynamics, model)
    if integrator is semi_implicit_euler and dynamics is free_motion and ctrl is not None:
        found = linearise_euler_step(model, t, state, given, dt)
        if found is not None:
            after, A, B = found
            return Linear(A, B, (after.v - state.v) / dt)
    field, state = Field(model, dynamics, dt), with_memory(model, state, dynamics)

    def advance(dx: jax.Array, du: jax.Array) -> State:
        at = box_plus(model, state, dx)
        return advance_state(integrator, field, t, at, _inputs(model, given, t, at, du), dt)

    zero = _zero(model, state, given)
    after = advance(*zero)
    # not by `jacfwd`, whose `vmap` would solve a contact problem for each column
    change = jax.linearize(lambda *d: box_minus(model, after, advance(*d)), *zero)[1]
    dx, du = (jnp.eye(len(x), dtype=x.dtype) for x in zero)
    A = jax.vmap(lambda x: change(x, zero[1]), out_axes=-1)(dx)
    B = jax.vmap(lambda u: change(zero[0], u), out_axes=-1)(du)
    return Linear(A, B, (after.v - state.v) / dt)


def _zero(model: Model, state: State, given: Inputs) -> tuple[jax.Array, jax.Array]:
    """Return zeros dx (2 nv + nx,) and du (nu,); du is empty without controls."""
    nu, dtype = 0 if given.ctrl is None else model.nu, state.q.dtype
    return jnp.zeros(2 * model.nv + model.nx, dtype), jnp.zeros(nu, dtype)


def _inputs(model: Model, given: Inputs, t: Any, state: State, du: jax.Array) -> Inputs:
    """Evaluate the inputs at a state and add du to the controls."""
    u = evaluated("linearise", model, given, t, state)
    return u if u.ctrl is None else u._replace(ctrl=u.ctrl + du)


def linearise_rates(
    model: Model, state: State, given: Inputs, t: Any = 0.0, dynamics: Any = free_motion
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the rates (nv + nx,) of v and x, and A and B of the continuous form."""
    n, dtype = model.nv, state.q.dtype
    if dynamics is free_motion and n:
        found, lower, B = _free_rates(model, state, given, t)
    else:
        found, lower, B = _rates(model, state, given, t, dynamics)
    turning = jnp.zeros((n, n), dtype)
    for at in model.topology.turn_starts:
        rows = slice(at, at + 3)
        turning = turning.at[rows, rows].set(-jnp.cross(state.v[rows], jnp.eye(3, dtype=dtype)).T)
    upper = [turning, jnp.eye(n, dtype=dtype), jnp.zeros((n, model.nx), dtype)]
    A = jnp.concatenate([jnp.concatenate(upper, 1), lower])
    return found, A, jnp.concatenate([jnp.zeros((n, B.shape[1]), dtype), B])


def _rates(
    model: Model, state: State, given: Inputs, t: Any, dynamics: Dynamics
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the rates (nv + nx,) of any dynamics and their derivatives by dx and du (jacfwd)."""

    def rates(dx: jax.Array, du: jax.Array) -> tuple[jax.Array, jax.Array]:
        at = box_plus(model, state, dx)
        a, x = Field(model, dynamics).rates(t, at, _inputs(model, given, t, at, du))
        found = a if x is None else jnp.concatenate([a, x])
        return found, found

    zero = _zero(model, state, given)
    (by_x, by_u), found = jax.jacfwd(rates, (0, 1), has_aux=True)(*zero)
    return found, by_x, by_u


def _free_rates(
    model: Model, state: State, given: Inputs, t: Any, dt: Any = None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the rates (nv + nx,) of free motion and their derivatives by dx and du, by the
    analytical derivatives of forward dynamics, which compile faster than jacfwd."""
    n, zero = model.nv, _zero(model, state, given)

    def forces(dx: jax.Array, du: jax.Array) -> jax.Array:
        at = box_plus(model, state, dx)
        tau, x = generalized_forces(model, t, at, _inputs(model, given, t, at, du), dt)
        return tau if x is None else jnp.concatenate([tau, x])

    if by_joint(model) and given.wrenches is None and not any(map(callable, given)):
        a, by = accelerated_derivatives(model, state.q, state.v, forces(*zero))
        a_x, a_u = times_jacobian(model, forces, zero[1].shape[0], by.tau)
        return a, a_x + jnp.concatenate([by.q, by.v], 1), a_u
    (F_x, F_u), F = jax.jacfwd(lambda *d: (forces(*d),) * 2, (0, 1), has_aux=True)(*zero)
    a, by = accelerated_derivatives(model, state.q, state.v, F[:n])
    a_x = matmat(by.tau, F_x[:n]).at[:, : 2 * n].add(jnp.concatenate([by.q, by.v], 1))
    a_u = matmat(by.tau, F_u[:n])
    return tuple(jnp.concatenate(x) for x in ((a, F[n:]), (a_x, F_x[n:]), (a_u, F_u[n:])))  # type: ignore[return-value]


def generalized_forces(
    model: Model, t: Any, state: State, inputs: Inputs, dt: Any = None
) -> tuple[jax.Array, jax.Array | None]:
    """Compute the sum of all applied forces as generalized forces (nv,), and x' (nx,)."""
    tau, f_ext, x = applied(model, t, state, inputs, dt)
    if f_ext:
        tau = tau + Context.of(model, t, state, None).generalized_of(f_ext)
    return tau, x


def box_plus(model: Model, state: State, dx: jax.Array) -> State:
    """Retract a state by a tangent vector: state (+) dx, dx = [dq; dv; dx_e]."""
    n = model.nv
    x = None if state.x is None else state.x + dx[2 * n :]
    q, v = integrate(model, state.q, dx[:n]), state.v + dx[n : 2 * n]
    return State(q, v, x, state.memory, state.report)


def box_minus(model: Model, one: State, other: State) -> jax.Array:
    """Compute the tangent vector dx with one (+) dx = other."""
    dx = [difference(model, one.q, other.q), other.v - one.v]
    if one.x is not None and other.x is not None:
        dx.append(other.x - one.x)
    return jnp.concatenate(dx)


def linearise_euler_step(
    model: Model, t: Any, state: State, given: Inputs, dt: Any
) -> tuple[State, jax.Array, jax.Array] | None:
    """Compute the state after a semi-implicit Euler step of free motion, A and B, by the analytical
    derivatives of forward dynamics. Return None if elements have states.

    dv+ = dv + dt da,   dq+ = E dq + dt J dv+,   da = a_q dq + a_v dv + M^-1 dtau,
        E and J of the step on the manifold
    """
    if model.nx or not model.nv:
        return None
    n, dtype = model.nv, state.q.dtype
    a, a_x, a_u = _free_rates(model, state, given, t, dt)
    v = state.v + dt * a
    q = integrate(model, state.q, dt * v)
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


Forces = Callable[[jax.Array, jax.Array], jax.Array]


def times_jacobian(
    model: Model, forces: Forces, nu: int, M: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute M F_x (n, 2 n) and M F_u (n, nu) with the Jacobians F_x, F_u of forces(dx, du) at
    zero, if each force depends only on the state of its own joint."""
    n, dtype = model.nv, M.dtype
    zero, none = jnp.zeros(2 * n, dtype), jnp.zeros(nu, dtype)
    top = model.topology
    sizes = [joint.nv for joint in top.joints]
    joint = np.repeat(np.arange(len(sizes)), sizes)
    place = np.concatenate([np.arange(k) for k in sizes])  # index of each dof within its joint
    drives = np.array(model.actuators.joints[:nu], int).reshape(nu)
    rank = np.array([(drives[:k] == drives[k]).sum() for k in range(nu)], int)
    b, c = max(sizes), max(rank, default=-1) + 1
    seeds = [np.concatenate([place == k, np.zeros(n)]) for k in range(b)]
    seeds += [np.roll(seed, n) for seed in seeds]
    along_x = np.stack([*seeds, *np.zeros((c, 2 * n))]).astype(dtype)
    along_u = np.stack([np.zeros(nu)] * (2 * b) + [rank == k for k in range(c)]).astype(dtype)

    def column(dx: jax.Array, du: jax.Array) -> jax.Array:
        return jax.jvp(forces, (zero, none), (dx, du))[1]

    columns = jax.vmap(column, out_axes=1)(jnp.asarray(along_x), jnp.asarray(along_u))
    by_q, by_v, by_u = columns[:, :b], columns[:, b : 2 * b], columns[:, 2 * b :]
    if b > 1:
        same = joint[:, None] == joint
        F_x = [jnp.where(same, block[:, place], 0.0) for block in (by_q, by_v)]
        F_u = jnp.where(joint[:, None] == drives, by_u[:, rank], 0.0)
        return matmat(M, jnp.concatenate(F_x, 1)), matmat(M, F_u)
    at = np.maximum(drives, 0)  # one dof per joint; an actuator without a joint has no force
    share = jnp.where(drives >= 0, by_u[at, rank], 0.0)
    return jnp.concatenate([M * by_q[:, 0], M * by_v[:, 0]], 1), M[:, at] * share


def by_joint(model: Model) -> bool:
    """Check whether each force depends only on the state of its own joint, and the model is so
    large that compressed Jacobians shorten the program."""
    local = not model.forces and all(site < 0 for site in model.actuators.sites)
    return local and model.nv > CPU_UNROLLED_UP_TO
