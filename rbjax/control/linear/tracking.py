"""A time-varying linear quadratic regulator along a motion of a model.

    dx_(k+1) = A_k dx_k + B_k du_k,     dx_k = state (-) states_k,     u = ctrl_k - K_k dx_k

Source: Anderson & Moore, *Optimal Control: Linear Quadratic Methods*, 2; Sola, *A micro Lie
theory*, 2018 (tangent spaces).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.compiling import compiled
from rbjax.constraints.formulation import Formulation
from rbjax.control.linear.arguments import weight_matrix
from rbjax.control.linear.riccati import Gains, backward, constant_weights
from rbjax.dynamics.arguments import check_array, check_model, check_step, shape_of
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.model.record import Record
from rbjax.motion.field import Dynamics, free_motion
from rbjax.motion.integrators import Integrator
from rbjax.motion.linearise import box_minus, linearise


class Tracking(Record):
    """A motion and the gains of its regulator: a policy (t, state) -> (nu,).

    model: the robot.
    states: q (N + 1, nq), v (N + 1, nv) and x (N + 1, nx).
    ctrl: controls along the motion, (N, nu).
    dt: the step, (), s.
    K: gains, (N, nu, n).
    P: matrices of the cost to go dx'P dx, (N + 1, n, n).
    success: as in `Gains`, ().
    """

    model: Model
    states: State
    ctrl: jax.Array
    dt: jax.Array
    K: jax.Array
    P: jax.Array
    success: jax.Array

    def __call__(self, t: Any, state: State) -> jax.Array:
        """Return the controls (nu,) at a time in s since the start of the motion. Times before the
        start use the first step, and times after the end use the last step."""
        k = jnp.floor(t / self.dt + 1e-3).astype(jnp.int32)  # times of knots are rounded
        k = jnp.clip(k, 0, self.ctrl.shape[0] - 1)
        K, u = self.K[k], self.ctrl[k]
        here = jax.tree.map(lambda x: x[k], self.states)
        return u - (K * box_minus(self.model, here, state)).sum(-1)


def time_varying_lqr(
    model: Model,
    states: State,
    ctrl: Any,
    dt: Any,
    Q: Any,
    R: Any,
    terminal: Any = None,
    *,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics = free_motion,
    constraints: str | Formulation | None = None,
) -> Tracking:
    """Compute the time-varying linear quadratic regulator along a motion of `rollout`.

        minimise  sum_k dx_k'Q dx_k + du_k'R du_k  +  dx_N'Q_N dx_N

    Args:
        model: the robot.
        states: a `Trajectory` or `State` with q (N + 1, nq) and v (N + 1, nv), as from `rollout`.
        ctrl: (N, nu).
        dt: seconds.
        Q: (n, n) or the weights (n,), n = 2 nv + nx.
        R: (nu, nu) or (nu,).
        terminal: Q_N, (n, n) or (n,); Q if None.
        integrator, dynamics, constraints: of the motion, as in `rb.linearise`.

    Returns:
        `Tracking`, which is a policy for `rb.rollout` and `rb.simulate`.

    Raises:
        InputError: shapes, values that are not finite, a step that is not positive.

    The motion may have gaps between knots. It is linearised about each knot, and gaps have no
    effect on the gains.

    Source: Anderson & Moore, 2.4.

    Example:
        >>> import jax.numpy as jnp, rbjax as rb
        >>> from rbjax.control import time_varying_lqr
        >>> model = rb.load("cart_pole")
        >>> u = jnp.ones((20, 1))
        >>> path = rb.rollout(model, model.default_state(), u, 0.01)
        >>> law = time_varying_lqr(model, path, u, 0.01, jnp.ones(4), jnp.ones(1))
        >>> law(0.05, path.state(5)).shape
        (1,)
    """
    where = "time_varying_lqr"
    check_model(where, model)
    shape = shape_of(where, "ctrl", ctrl)
    if len(shape) != 2 or not shape[0]:
        hint = "; for a batch use jax.vmap" if len(shape) == 3 else ""
        raise InputError(f"{where}: ctrl has shape {shape}, expected (N, {model.nu}){hint}")
    N, n = shape[0], 2 * model.nv + model.nx
    u = check_array(where, "ctrl", ctrl, (N, model.nu))
    if not (hasattr(states, "q") and hasattr(states, "v")):
        raise InputError(
            f"{where}: states is {type(states).__name__}, expected a State or Trajectory of "
            f"{N + 1} states"
        )
    q = check_array(where, "states.q", states.q, (N + 1, model.nq))
    v = check_array(where, "states.v", states.v, (N + 1, model.nv))
    x = getattr(states, "x", None)
    x = check_array(where, "states.x", x, (N + 1, model.nx)) if model.nx else None
    dtype = jnp.result_type(q, v, u)
    Q, R = weight_matrix(where, "Q", Q, n), weight_matrix(where, "R", R, model.nu)
    end = Q if terminal is None else weight_matrix(where, "terminal", terminal, n)
    Q, R, end, q, v, u = (y.astype(dtype) for y in (Q, R, end, q, v, u))
    dt = check_step(where, "dt", dt, dtype)
    along = State(q, v, x)
    starts = jax.tree.map(lambda y: y[:-1], along)

    options: Any = {"integrator": integrator, "dynamics": dynamics, "constraints": constraints}

    def of(state: State, ctrl: jax.Array) -> Any:
        return linearise(model, state, ctrl, dt, **options)

    gains = regulator_along(*jax.vmap(of)(starts, u), Q, R, end)
    return Tracking(model, along, u, dt, gains.K, gains.P, gains.success)


@compiled
def regulator_along(
    A: jax.Array, B: jax.Array, Q: jax.Array, R: jax.Array, terminal: jax.Array
) -> Gains:
    """Compute the gains for A (N, n, n) and B (N, n, m), with the same Q and R at each step."""
    return backward(constant_weights(A, B, Q, R, terminal))
