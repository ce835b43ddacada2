"""Linear quadratic regulators: of two matrices, of a model at a state, of a finite horizon.

    continuous  minimise  integral of x'Qx + u'Ru + 2 x'Su,   dx/dt = A x + B u
    discrete    minimise  sum of      x'Qx + u'Ru + 2 x'Su,   x+ = A x + B u

The law is u = -K x, and the least cost from x is x'Px (the factor 1/2 of `riccati.py` scales both).
For infinite horizon P solves an algebraic Riccati equation (`algebraic_riccati.py`).

A model is linearised on the tangent space of its configuration, x = [dq; dv; dx_e], so attitudes
are three coordinates and the law is u = u_0 - K (state (-) state_0).
Source: Anderson & Moore, *Optimal Control: Linear Quadratic Methods*, 2, 3; Lancaster & Rodman,
*Algebraic Riccati Equations*.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import flag, integer
from rbjax.compiling import compiled
from rbjax.constraints.formulation import Formulation
from rbjax.control.linear.algebraic_riccati import riccati
from rbjax.control.linear.riccati import Gains, backward, constant_problem
from rbjax.control.status import LinearStatus, raise_failure
from rbjax.dynamics.arguments import check_array, check_arrays, check_model, shape_of
from rbjax.errors import InputError
from rbjax.kinematics.arguments import known_array
from rbjax.model import Model, State
from rbjax.motion.field import Dynamics, free_motion
from rbjax.motion.integrators import Integrator
from rbjax.motion.linearise import box_minus, linearise


class Regulator(NamedTuple):
    """A regulator of infinite horizon; K and P are 0 without a solution.

    K: (m, n), of u = -K x.
    P: (n, n), the least cost is x'Px.
    residual: (), the largest entry of the residual of the Riccati equation over its largest term.
    error: (), a bound of the relative error of P by rounding.
    status: a `LinearStatus`.
    acceleration: (nv,), of `lqr_at`: v' at the state under the controls, zero at an equilibrium;
        None for `lqr`.
    """

    K: jax.Array
    P: jax.Array
    residual: jax.Array
    error: jax.Array
    status: Any
    acceleration: jax.Array | None = None

    @property
    def success(self) -> jax.Array:
        """Whether there is a solution."""
        return self.status == LinearStatus.success


def lqr(A: Any, B: Any, Q: Any, R: Any, S: Any = None, *, discrete: bool = False) -> Regulator:
    """The regulator u = -K x of infinite horizon.

        A'P + PA + Q - (PB + S) R^-1 (PB + S)' = 0,   K = R^-1 (PB + S)'

    or, discrete,

        A'PA - P + Q - K'(R + B'PB) K = 0,            K = (R + B'PB)^-1 (A'PB + S)'

    Args:
        A: (n, n). B: (n, m).
        Q: (n, n), symmetric; or the weights (n,).
        R: (m, m), symmetric and positive definite; or the weights (m,). If discrete, R + B'PB must
            be positive definite instead.
        S: (n, m), of 2 x'Su; 0 if None.
        discrete: whether x+ = A x + B u instead of dx/dt = A x + B u.

    Returns:
        `Regulator`, of the solution for which A - BK is stable. It is found where Q is positive
        semidefinite (with S) and (A, B) can be stabilised, unless a mode on the edge of stability
        has no cost. In traced code `status` says if there is none, and why.

    Raises:
        InputError: shapes, values that are not finite, Q or R that is not symmetric; outside of
            traced code also if there is no stabilising solution.

    Differentiable in all matrices, in both modes, by the implicit function theorem. f64 gives 1e-12
    on problems of moderate condition; `error` estimates it.

    Source: see the module.

    Example:
        >>> from rbjax.control import lqr
        >>> found = lqr([[0.0, 1.0], [0.0, 0.0]], [[0.0], [1.0]], [1.0, 0.0], [1.0])
        >>> [round(float(k), 5) for k in found.K[0]]
        [1.0, 1.41421]
    """
    A, B, Q, R, S = _matrices("lqr", A, B, Q, R, S)
    discrete = flag("lqr", "discrete", discrete)
    P, K, residual, error, status = riccati(A, B, Q, R, S, bool(discrete))
    raise_failure("lqr", status)
    return Regulator(K, P, residual, error, status)


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
    """The regulator of a model about a state that its controls hold still.

        u = ctrl - K (state' (-) state),    (A, B) = rb.linearise(model, state, ctrl, dt)

    Args:
        model: the robot.
        state: about which to linearise, with n = 2 nv + nx tangent coordinates dq, dv, dx_e.
        ctrl: (nu,) that hold it there.
        Q: (n, n), or the weights (n,).
        R: (nu, nu), or the weights (nu,).
        S: (n, nu); 0 if None.
        dt: seconds, for controls that are held over a step of `rollout`; None for continuous time.
        integrator, dynamics, constraints: as in `rb.linearise`.

    Returns:
        `Regulator`. `feedback` makes a policy of its K. If its acceleration is not zero, ctrl does
        not hold the robot at the state, and the closed loop comes to rest at another point.

    Raises:
        InputError: as `rb.linearise` and `lqr`.

    Constraints take directions out of the reach of every control, and their modes neither grow nor
    decay: such a model is `not_stabilisable` in all its coordinates.

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
    A, B, Q, R, S = _matrices("lqr_at", linear.A, linear.B, Q, R, S)
    P, K, residual, error, status = riccati(A, B, Q, R, S, dt is not None)
    raise_failure("lqr_at", status)
    return Regulator(K, P, residual, error, status, linear.acceleration)


def lqr_finite(
    A: Any, B: Any, Q: Any, R: Any, horizon: int, terminal: Any = None, S: Any = None
) -> Gains:
    """The discrete regulator of N steps: u_k = -K_k x_k.

    Args:
        A: (n, n). B: (n, m).
        Q: (n, n) or (n,). R: (m, m) or (m,).
        horizon: N.
        terminal: Q_N, (n, n) or (n,); Q if None.
        S: (n, m); 0 if None.

    Returns:
        `Gains`, K (N, m, n) and P (N + 1, n, n).

    Raises:
        InputError: shapes, values that are not finite.

    Source: Anderson & Moore, 2.4.

    Example:
        >>> from rbjax.control.linear import lqr_finite
        >>> lqr_finite([[1.0]], [[1.0]], [1.0], [1.0], 5).K.shape
        (5, 1, 1)
    """
    A, B, Q, R, S = _matrices("lqr_finite", A, B, Q, R, S)
    integer("lqr_finite", "horizon", horizon, least=1, why=" steps")
    end = Q if terminal is None else weights("lqr_finite", "terminal", terminal, A.shape[0])
    return _finite(A, B, Q, R, int(horizon), end, S)


@functools.partial(compiled, static_argnums=4)
def _finite(
    A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, horizon: int, end: Any, S: Any
) -> Gains:
    return backward(constant_problem(A, B, Q, R, horizon, end, S))


def feedback(model: Model, state: State, ctrl: Any, K: Any) -> Any:
    """The policy (t, state') -> ctrl - K (state' (-) state), for `rb.rollout` and `rb.simulate`.

    Args:
        model: the robot.
        state: that is held.
        ctrl: (nu,) there.
        K: (nu, 2 nv + nx).

    Returns:
        A function whose arrays are leaves, so that it passes through `jit` and `vmap`.

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


def weights(where: str, name: str, value: Any, n: int) -> jax.Array:
    """A matrix (n, n), of one or of its diagonal (n,)."""
    x = check_array(where, name, value, (n, n), (n,))
    return jnp.diag(x) if x.ndim == 1 else x


def _check_symmetric(where: str, name: str, W: jax.Array) -> None:
    """`InputError` if a matrix is not symmetric. Traced values are not checked."""
    known = known_array(W)
    if known is None:
        return
    off = np.abs(known - known.T).max()
    if off > np.sqrt(np.finfo(W.dtype).eps) * np.abs(known).max():
        raise InputError(
            f"{where}: {name} is not symmetric, {name} - {name}' has entries up to {off:.3g}; give "
            f"({name} + {name}') / 2"
        )


def _matrices(where: str, A: Any, B: Any, Q: Any, R: Any, S: Any) -> tuple[jax.Array, ...]:
    shapes = shape_of(where, "A", A), shape_of(where, "B", B)
    if len(shapes[0]) != 2 or len(shapes[1]) != 2 or not (shapes[0][0] and shapes[1][1]):
        hint = "; for a batch use jax.vmap" if len(shapes[0]) == 3 else ""
        raise InputError(
            f"{where}: A and B have shapes {shapes[0]} and {shapes[1]}, expected (n, n) and (n, m) "
            f"with one state and one control or more{hint}"
        )
    n, m = shapes[0][0], shapes[1][1]
    A, B = check_array(where, "A", A, (n, n)), check_array(where, "B", B, (n, m))
    Q, R = weights(where, "Q", Q, n), weights(where, "R", R, m)
    for name, W in (("Q", Q), ("R", R)):
        _check_symmetric(where, name, W)
    S = jnp.zeros_like(B) if S is None else check_array(where, "S", S, (n, m))
    dtype = jnp.result_type(A, B, Q, R, S)
    return tuple(x.astype(dtype) for x in (A, B, Q, R, S))
