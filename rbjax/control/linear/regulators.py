"""Linear quadratic regulators of infinite horizon: of matrices A and B, of a model at a state.

    continuous  minimise  integral of x'Qx + u'Ru + 2 x'Su,   dx/dt = A x + B u
    discrete    minimise  sum of      x'Qx + u'Ru + 2 x'Su,   x+ = A x + B u

The feedback is u = -K x, and the minimum cost from x is x'Px. A model is linearised on the tangent
space, x = [dq; dv; dx_e]. The gain of the steady Kalman filter is the regulator of the transposed
system, (A', C', W, V) for (A, B, Q, R).
Source: Anderson & Moore, *Optimal Control: Linear Quadratic Methods*, 2, 3.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve

from rbjax.arguments import flag
from rbjax.constraints.formulation import Formulation
from rbjax.control.linear.algebraic_riccati import Regulator, riccati
from rbjax.control.linear.arguments import check_matrices, check_regulator, weight_matrix
from rbjax.control.products import definite_factor, product
from rbjax.control.status import LinearStatus, raise_failure
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_array, check_arrays, check_model
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.motion.field import Dynamics, free_motion
from rbjax.motion.integrators import Integrator
from rbjax.motion.linearise import box_minus, linearise


def lqr(A: Any, B: Any, Q: Any, R: Any, S: Any = None, *, discrete: bool = False) -> Regulator:
    """Compute the linear quadratic regulator u = -K x of infinite horizon.

        A'P + PA + Q - (PB + S) R^-1 (PB + S)' = 0,   K = R^-1 (PB + S)'

    or, discrete,

        A'PA - P + Q - K'(R + B'PB) K = 0,            K = (R + B'PB)^-1 (A'PB + S)'

    Args:
        A: (n, n).
        B: (n, m).
        Q: (n, n), symmetric; or the weights (n,).
        R: (m, m), symmetric and positive definite; or the weights (m,). If discrete, R + B'PB must
            be positive definite instead.
        S: (n, m), of 2 x'Su; 0 if None.
        discrete: true for x+ = A x + B u, false for dx/dt = A x + B u.

    Returns:
        `Regulator`, with A - BK stable. It exists if Q is positive semidefinite (with S) and (A, B)
        is stabilisable, unless a mode on the edge of stability has no cost. In traced code `status`
        contains the reason if there is none.

    Raises:
        InputError: shapes, values that are not finite, Q or R that is not symmetric; outside of
            traced code also if there is no stabilising solution.

    Differentiable in all matrices, in both modes, by the implicit function theorem. The relative
    accuracy in f64 is 1e-12 on problems of moderate condition; `error` estimates it.

    Source: `rbjax.control.linear.algebraic_riccati`.

    Example:
        >>> from rbjax.control import lqr
        >>> found = lqr([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [1.0, 0.0], [1.0])
        >>> [round(float(k), 5) for k in found.K[0]]
        [1.0, 1.41421]
    """
    A, B, Q, R, S = check_regulator("lqr", A, B, Q, R, S)
    discrete = flag("lqr", "discrete", discrete)
    found = riccati(A, B, Q, R, S, bool(discrete))
    raise_failure("lqr", found.status)
    return found


def lqr_at(
    model: Model,
    state: State,
    ctrl: Any,
    Q: Any,
    R: Any,
    S: Any = None,
    *,
    dt: Any = None,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics = free_motion,
    constraints: str | Formulation | None = None,
) -> Regulator:
    """Compute the regulator of a model about a state that is an equilibrium under its controls.

        u = ctrl - K (state' (-) state),    (A, B) = rb.linearise(model, state, ctrl, dt)

    Args:
        model: the robot.
        state: the equilibrium, with n = 2 nv + nx tangent coordinates dq, dv, dx_e.
        ctrl: (nu,) controls at the equilibrium.
        Q: (n, n), or the weights (n,).
        R: (nu, nu), or the weights (nu,).
        S: (n, nu); 0 if None.
        dt: seconds, for controls that are constant over a step; None for continuous time.
        integrator, dynamics, constraints: as in `rb.linearise`.

    Returns:
        `Regulator`. `feedback` makes a policy from its K. If its acceleration is not zero, the
        state is not an equilibrium, and the closed loop comes to rest at another point.

    Raises:
        InputError: as `rb.linearise` and `lqr`.

    Constrained directions are not controllable, and their modes neither grow nor decay. A model
    with constraints is therefore `not_stabilisable` in all its coordinates.

    Source: Bryson & Ho, *Applied Optimal Control*, 5.

    Example:
        >>> import jax.numpy as jnp, rbjax as rb
        >>> from rbjax.control import lqr_at
        >>> model = rb.load("pendulum")
        >>> up = rb.State(jnp.array([jnp.pi]), jnp.zeros(1))
        >>> lqr_at(model, up, jnp.zeros(1), jnp.ones(2), jnp.ones(1)).K.shape
        (1, 2)
    """
    if dt is None and integrator is not None:
        raise InputError(
            f"lqr_at: got integrator={integrator!r} without dt, expected a step in s; continuous "
            "time has no integrator"
        )
    linear = linearise(
        model, state, ctrl, dt, integrator=integrator, dynamics=dynamics, constraints=constraints
    )
    A, B, Q, R, S = check_regulator("lqr_at", linear.A, linear.B, Q, R, S)
    found = riccati(A, B, Q, R, S, dt is not None)
    raise_failure("lqr_at", found.status)
    return found._replace(acceleration=linear.acceleration)


def feedback(model: Model, state: State, ctrl: Any, K: Any) -> Any:
    """Build the policy (t, state') -> ctrl - K (state' (-) state), for `rb.rollout`.

    Args:
        model: the robot.
        state: the reference state.
        ctrl: (nu,) controls at the reference state.
        K: (nu, 2 nv + nx).

    Returns:
        A callable pytree whose arrays are leaves, for use in `jit` and `vmap`.

    Raises:
        InputError: shapes, values that are not finite.

    Example:
        >>> import jax.numpy as jnp, rbjax as rb
        >>> from rbjax.control import feedback, lqr_at
        >>> model = rb.load("pendulum")
        >>> up, u = rb.State(jnp.array([jnp.pi]), jnp.zeros(1)), jnp.zeros(1)
        >>> K = lqr_at(model, up, u, jnp.ones(2), jnp.ones(1)).K
        >>> start = rb.State(up.q + 0.1, up.v)
        >>> path = rb.rollout(model, start, feedback(model, up, u, K), 0.01, steps=1000)
        >>> bool(abs(path.q[-1, 0] - jnp.pi) < 1e-3)
        True
    """
    check_model("feedback", model)
    K = check_array("feedback", "K", K, (model.nu, 2 * model.nv + model.nx))
    ctrl = check_array("feedback", "ctrl", ctrl, (model.nu,))
    state = check_arrays("feedback", model, {"state": state}, ())["state"]
    return jax.tree_util.Partial(_feedback, model, state, ctrl, K)


def _feedback(model: Model, held: State, ctrl: Any, K: Any, t: Any, state: State) -> jax.Array:
    del t
    return ctrl - (K * box_minus(model, held, state)).sum(-1)


@displayed
class SteadyFilter(NamedTuple):
    """A steady Kalman filter.

    gain: (n, l).
    P: covariance of the error, (n, n); in discrete time before the update by a sample.
    residual, error, status: as in `Regulator`.
    """

    gain: jax.Array
    P: jax.Array
    residual: jax.Array
    error: jax.Array
    status: Any

    @property
    def success(self) -> jax.Array:
        """True if there is a solution."""
        return self.status == LinearStatus.success


def kalman_gain(A: Any, C: Any, W: Any, V: Any, *, discrete: bool = False) -> SteadyFilter:
    """Compute the gain L of the steady Kalman filter of dx/dt = A x + w, y = C x + e.

        continuous  dx/dt = A x + B u + L (y - C x),    L = P C' V^-1
        discrete    x <- x + L (y - C x), then x+ = A x + B u,   L = P C' (C P C' + V)^-1

    Args:
        A: (n, n).
        C: (l, n).
        W: intensity (discrete: covariance) of w, (n, n) or (n,).
        V: intensity (discrete: covariance) of e, (l, l) or (l,), positive definite.
        discrete: true for x+ = A x + w.

    Returns:
        `SteadyFilter`. The status `not_stabilisable` means that (A, C) is not detectable.

    Raises:
        InputError: shapes, values that are not finite.

    Differentiable in both modes.

    Source: Kalman & Bucy 1961; Anderson & Moore, *Optimal Filtering*, 4.4.

    Example:
        >>> from rbjax.control.linear import kalman_gain
        >>> found = kalman_gain([[0.0, 1.0], [0.0, 0.0]], [[1.0, 0.0]], [0.0, 4.0], [1.0])
        >>> [round(float(x), 6) for x in found.gain[:, 0]]  # sqrt 2 w and w^2, w^2 = 2
        [2.0, 2.0]
    """
    A, C = check_matrices("kalman_gain", ("A", A, "nn"), ("C", C, "ln"))
    discrete = flag("kalman_gain", "discrete", discrete)
    W = weight_matrix("kalman_gain", "W", W, A.shape[0])
    V = weight_matrix("kalman_gain", "V", V, C.shape[0])
    dtype = jnp.result_type(A, C, W, V)
    A, C, W, V = (x.astype(dtype) for x in (A, C, W, V))
    found = riccati(A.T, C.T, W, V, jnp.zeros_like(C.T), discrete)
    gain = found.K.T
    if discrete:
        S = product(C, product(found.P, C.T)) + V
        L, ok = definite_factor((S + S.T) / 2)
        gain = jnp.where(ok, cho_solve((L, True), product(C, found.P)).T, 0.0)
    return SteadyFilter(gain, found.P, found.residual, found.error, found.status)
