"""Linearised motion of a robot at given states (`rb.linearise`), and equilibria."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, instance, real_array
from rbjax.constraints import residual
from rbjax.constraints.equations.soft_weights import with_weights
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_arrays, check_model
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError
from rbjax.forces.inputs import Inputs
from rbjax.model import Model, State, with_constants
from rbjax.motion.field import dynamics_of, free_motion
from rbjax.motion.linearise import box_plus, linearise, linearise_rates
from rbjax.rank_tolerances import rank_tolerance


@algorithm("state", "ctrl")
def state_matrix(model: Model, state: State, ctrl: ArrayLike | None = None) -> jax.Array:
    """Compute the matrix A of the linearised motion d/dt dx = A dx, at constant control.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))` about which to linearise.
        ctrl: (nu,) controls; None for no actuation.

    Returns:
        (n, n), n = 2 nv + nx, in 1/s and 1/s^2, for dx = [dq; dv; dx_e]. dq is in the tangent
        space, in the coordinates of v. dx_e are the states of force elements.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite.

    Source: Carpentier & Mansard, *Analytical derivatives of rigid body dynamics*, RSS 2018.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> rb.stability.state_matrix(model, model.default_state()).shape
        (2, 2)
    """
    dynamics = dynamics_of("state_matrix", model, free_motion, None)
    return linearise_rates(model, state, Inputs(ctrl), dynamics=dynamics)[1]


@displayed
class ReducedLinearisation(NamedTuple):
    """Linearisation on the tangent space of the constraints: d/dt dz = A dz + B du.

    Fields:
        A: (r, r).
        B: (r, nu).
        basis: (n, r) T of dx = T dz, with orthonormal columns.
    """

    A: np.ndarray
    B: np.ndarray
    basis: np.ndarray


def reduced_linearisation(
    model: Model, state: State, ctrl: Any = None, dt: Any = None
) -> ReducedLinearisation:
    """Linearise the motion about an equilibrium, on the tangent space of the constraints:

        d/dt dz = A dz + B du,     dx = T dz,     [g_q 0; g'_q g'_v] T = 0

    `rb.linearise` returns all n = 2 nv + nx directions. Directions that leave the constraints have
    eigenvalues of zero, or the eigenvalues of a feedback such as Baumgarte's. They are not
    controllable, so no regulator exists. r = n - rank of the matrix above: twice the degrees of
    freedom if all rows are holonomic and nx = 0.

    Args:
        model: the robot, with or without constraints.
        state: an equilibrium on the constraints, from `equilibrium`.
        ctrl: (nu,), or None.
        dt: step in seconds of the discrete form; None for the continuous one.

    Returns:
        `ReducedLinearisation(A, B, basis)`. A gain K of du = K dz becomes du = K basis^T dx.

    Raises:
        InputError: a state off the constraints; wrong shapes, values that are not finite.

    Source: Masarati, *Multibody System Dynamics*, ch. 7 (coordinates of the tangent space).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("four_bar")
        >>> rest = rb.stability.equilibrium(model, model.default_state())
        >>> rb.stability.reduced_linearisation(model, rest).A.shape
        (2, 2)
    """
    found = check_arrays("reduced_linearisation", model, {"state": state, "ctrl": ctrl})
    state = found["state"]
    A, B = (np.asarray(x, float) for x in linearise(model, state, found.get("ctrl"), dt))
    if not model.constraints:
        return ReducedLinearisation(A, B, np.eye(len(A)))
    off, C = (np.asarray(x, float) for x in _tangent(model, state))
    near = np.sqrt(np.finfo(np.asarray(state.q).dtype).eps)
    if np.abs(off).max(initial=0.0) > near:
        raise InputError(
            f"reduced_linearisation: the state is off the constraints by {np.abs(off).max():.1e}, "
            "expected a state on them; rb.constraints.assemble(model, state) finds one"
        )
    size = np.linalg.norm(C, axis=1, keepdims=True)
    C = C / np.where(size > near, size, np.inf)
    _, s, V = np.linalg.svd(C)
    T = V[int((s > near).sum()) :].T
    return ReducedLinearisation(T.T @ A @ T, T.T @ B, T)


@jax.jit
def _tangent(model: Model, state: State) -> tuple[jax.Array, jax.Array]:
    """Return the residuals of values and rates, and their derivatives with respect to dx."""

    def off(dx: jax.Array) -> tuple[jax.Array, jax.Array]:
        found = jnp.concatenate(residual(model, box_plus(model, state, dx)))
        return found, found

    C, found = jax.jacfwd(off, has_aux=True)(jnp.zeros(2 * model.nv + model.nx, state.q.dtype))
    return found, C


@jax.jit
def _both(model: Model, state: State, ctrl: Any) -> tuple[jax.Array, jax.Array]:
    """Return the rates (nv + nx,) and A, with the constraints of the model."""
    dynamics = dynamics_of("state_matrix", model, free_motion, None)
    return linearise_rates(model, state, Inputs(ctrl), dynamics=dynamics)[:2]


def _rates_and_matrix(model: Model, ctrl: Any) -> Callable[[State], tuple[jax.Array, jax.Array]]:
    """Return the function of a state that computes the rates and A.

    Link constants and the inverse weights of contacts are precomputed. Otherwise the program, of
    which the model is an argument, computes them from the model's leaves.
    """
    dtype = model.gravity.dtype
    weighted = model if model.contact is None else with_weights(model, dtype)
    known = with_constants(weighted, dtype)
    return lambda state: _both(known, state, ctrl)


def _vanishes(a: np.ndarray, A: np.ndarray) -> bool:
    """Return whether an acceleration is zero up to rounding."""
    return bool(np.abs(a).max() < 1e3 * np.finfo(A.dtype).eps * (1 + np.abs(A).max()))


def at_rest(where: str, model: Model, state: State, ctrl: Any) -> State:
    """Return the state as arrays. Raise InputError if it moves, accelerates or is unstable."""
    found = check_arrays(where, model, {"state": state, "ctrl": ctrl})
    if not model.nv:
        raise InputError(f"{where}: the model has no joints, so nothing moves")
    state = found["state"]
    a, A = map(np.asarray, _rates_and_matrix(model, found.get("ctrl"))(state))
    if np.abs(state.v).max() > 0 or not _vanishes(a, A):
        raise InputError(
            f"{where}: the state moves at {np.abs(state.v).max():.1e} and accelerates at "
            f"{np.abs(a).max():.1e}, expected one at rest; rb.stability.equilibrium(model, state, "
            "ctrl) finds one near it"
        )
    if model.constraints:
        A = reduced_linearisation(model, state, found.get("ctrl")).A
    eigenvalues = np.linalg.eigvals(A)
    grows = eigenvalues.real.max()
    # a double root, as for a free coordinate, has an error of sqrt(rounding)
    if grows > 10 * np.sqrt(np.finfo(A.dtype).eps) * np.abs(eigenvalues).max():
        raise InputError(
            f"{where}: this equilibrium is unstable, the exact motion departs from it as "
            f"exp({grows:.2g} t); expected a stable one"
        )
    return state


@jax.jit
def _matrices(model: Model, q: jax.Array, v: jax.Array, ctrl: jax.Array | None) -> jax.Array:
    axis = None if ctrl is None or ctrl.ndim == 1 else 0
    along = jax.vmap(lambda q, v, u: state_matrix(model, State(q, v), u), (0, 0, axis))
    return along(q, v, ctrl)


def motion_matrices(model: Model, states: State, ctrl: Any = None) -> np.ndarray:
    """Compute the `state_matrix` at each state of a motion.

    Args:
        model: the robot.
        states: `State(q (T, nq), v (T, nv))`.
        ctrl: (nu,), (T, nu) or None.

    Returns:
        (T, 2 nv, 2 nv), 1/s, in SI units.

    Raises:
        InputError: not a model or states, or wrong shapes.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> model = rb.load("pendulum")
        >>> states = rb.State(np.zeros((9, 1)), np.zeros((9, 1)))
        >>> np.linalg.eigvals(rb.stability.motion_matrices(model, states)).shape
        (9, 2)
    """
    check_model("motion_matrices", model)
    instance("motion_matrices", "states", states, State, "State(q, v) of arrays")
    real_array("motion_matrices", "states.q", states.q)
    real_array("motion_matrices", "states.v", states.v)
    q, v = jnp.asarray(states.q), jnp.asarray(states.v)
    if q.ndim != 2 or v.ndim != 2 or len(q) != len(v):
        raise InputError(
            f"motion_matrices: q has shape {q.shape} and v {v.shape}, expected (T, nq), (T, nv)"
        )
    ctrl = None if ctrl is None else jnp.asarray(ctrl, q.dtype)
    return np.asarray(_matrices(model, q, v, ctrl), np.float64)


def equilibrium(model: Model, state: State, ctrl: Any = None, *, steps: int = 50) -> State:
    """Find the equilibrium near `state`, on the constraints and at constant control.

    Newton's method solves a(q, 0, x) = 0, x' = 0, g(q) = 0, by least squares if the equilibrium is
    not isolated.

    Args:
        model: the robot.
        state: initial guess; its velocity is not used.
        ctrl: (nu,), or None.
        steps: largest number of iterations.

    Returns:
        `State` at rest.

    Raises:
        InputError: no equilibrium is found; wrong shapes, values that are not finite.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> model = rb.load("pendulum")
        >>> rest = rb.stability.equilibrium(model, rb.State(np.array([0.3]), np.zeros(1)))
        >>> bool(abs(rest.q[0]) < 1e-9)
        True
    """
    found = check_arrays("equilibrium", model, {"state": state, "ctrl": ctrl})
    state, ctrl, n = found["state"], found.get("ctrl"), model.nv
    state = state.replace(v=jnp.zeros_like(state.v))
    if not isinstance(steps, int) or isinstance(steps, bool) or steps < 1:
        raise InputError(f"equilibrium: steps is {steps!r}, expected an integer of at least 1")
    if not n:
        return state
    both = _rates_and_matrix(model, ctrl)
    for _ in range(steps):
        a, A = map(np.asarray, both(state))
        rest = np.delete(np.arange(len(A)), np.s_[n : 2 * n])  # all except the velocities
        left, slope = a, A[n:, rest]
        off = np.zeros(0)
        if model.constraints:
            off, C = map(np.asarray, _tangent(model, state))
            off, rate = np.split(off, 2)
            left, slope = np.r_[a, off], np.r_[slope, C[: len(off), rest]]
        near = 1e3 * np.finfo(A.dtype).eps
        if _vanishes(a, A) and np.abs(off).max(initial=0.0) <= near:
            if off.size and np.abs(rate).max() > near:
                raise InputError(
                    f"equilibrium: the constraints demand rates of {np.abs(rate).max():.1e}, so no "
                    "state at rest meets them"
                )
            return state
        dx = np.zeros(len(A))
        dx[rest] = np.linalg.lstsq(slope, -left, rcond=rank_tolerance("equilibrium", A.dtype))[0]
        dx = dx * min(1.0, 0.5 / max(np.abs(dx).max(), 1e-300))
        state = box_plus(model, state, jnp.asarray(dx, state.q.dtype))
    raise InputError(
        f"equilibrium: an acceleration of {np.abs(a).max():.1e} is left after {steps} steps, "
        + (f"and a residual of constraints of {np.abs(off).max():.1e}, " if off.size else "")
        + "expected none; start closer to an equilibrium, if there is one"
        + (
            "; for a robot in contact, start from the end of a rollout in which it settles"
            if model.contact is not None
            else ""
        )
    )
