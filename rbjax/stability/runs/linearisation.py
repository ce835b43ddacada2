"""Motions linearised at given states (`rb.linearise`), and equilibria."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import algorithm, check_arrays
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.motion.linearise import beside, linearised


@algorithm("state", "ctrl")
def state_matrix(model: Model, state: State, ctrl: jax.Array | None = None) -> jax.Array:
    """A (n, n), n = 2 nv + nx, of the linearised motion d/dt dx = A dx, at constant control.

    Args:
        model: the robot.
        state: `State(q (nq,), v (nv,))` about which to linearise.
        ctrl: (nu,) controls; None for no actuation.

    Returns:
        (n, n) in 1/s and 1/s^2, dx = [dq; dv; dx_e]: dq on the tangent space, in the coordinates
        of v, and dx_e of the states of force elements.

    Raises:
        InputError: wrong shapes or dtypes, values that are not finite.

    Source: Carpentier & Mansard, *Analytical derivatives of rigid body dynamics*, RSS 2018.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("pendulum")
        >>> rb.stability.state_matrix(model, model.default_state()).shape
        (2, 2)
    """
    return linearised(model, state, ctrl)[1]


_both = jax.jit(lambda *at: linearised(*at)[:2])


def _vanishes(a: np.ndarray, A: np.ndarray) -> bool:
    """Whether an acceleration is only rounding."""
    return bool(np.abs(a).max() < 1e3 * np.finfo(A.dtype).eps * (1 + np.abs(A).max()))


def at_rest(where: str, model: Model, state: State, ctrl: Any) -> State:
    """The state, in arrays. `InputError` if it moves or accelerates, or is unstable."""
    found = check_arrays(where, model, {"state": state, "ctrl": ctrl})
    if not model.nv:
        raise InputError(f"{where}: the model has no joints, so nothing moves")
    state = found["state"]
    a, A = map(np.asarray, _both(model, state, found.get("ctrl")))
    if np.abs(state.v).max() > 0 or not _vanishes(a, A):
        raise InputError(
            f"{where}: the state moves at {np.abs(state.v).max():.1e} and accelerates at "
            f"{np.abs(a).max():.1e}, expected one at rest; rb.stability.equilibrium(model, state, "
            "ctrl) finds one near it"
        )
    eigenvalues = np.linalg.eigvals(A)
    grows = eigenvalues.real.max()
    # a double root, as of a free coordinate, has an error of sqrt(rounding)
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
    """`state_matrix` (T, 2 nv, 2 nv) at states q (T, nq), v (T, nv); ctrl (nu,), (T, nu) or None.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> model = rb.load("pendulum")
        >>> states = rb.State(np.zeros((9, 1)), np.zeros((9, 1)))
        >>> np.linalg.eigvals(rb.stability.motion_matrices(model, states)).shape
        (9, 2)
    """
    q, v = jnp.asarray(states.q), jnp.asarray(states.v)
    if q.ndim != 2 or v.ndim != 2 or len(q) != len(v):
        raise InputError(
            f"motion_matrices: q has shape {q.shape} and v {v.shape}, expected (T, nq), (T, nv)"
        )
    ctrl = None if ctrl is None else jnp.asarray(ctrl, q.dtype)
    return np.asarray(_matrices(model, q, v, ctrl), np.float64)


def equilibrium(model: Model, state: State, ctrl: Any = None, *, steps: int = 50) -> State:
    """The equilibrium near `state`: a state at rest without acceleration, at constant control.

    Newton's method on a(q, 0, x) = 0, x' = 0; least squares if the equilibrium is not isolated.

    Args:
        model: the robot.
        state: the first guess; its velocity is not used.
        ctrl: (nu,), or None.
        steps: the largest number of iterations.

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
    for _ in range(steps):
        a, A = map(np.asarray, _both(model, state, ctrl))
        if _vanishes(a, A):
            return state
        dx = np.zeros(len(A))
        rest = np.delete(np.arange(len(A)), np.s_[n : 2 * n])  # all except the velocities
        dx[rest] = np.linalg.lstsq(A[n:, rest], -a, rcond=1e-10)[0]
        dx = dx * min(1.0, 0.5 / max(np.abs(dx).max(), 1e-300))
        state = beside(model, state, jnp.asarray(dx, state.q.dtype))
    raise InputError(
        f"equilibrium: an acceleration of {np.abs(a).max():.1e} is left after {steps} steps, "
        "expected none; start closer to an equilibrium, if there is one"
    )
