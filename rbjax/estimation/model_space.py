"""The state space of a Kalman filter about a model, on the tangent space of its states.

`kalman_update` and `kalman_predict` are the two halves of a filter, to be called around a control
law:

    x <- update(x, y);   u = law(t, x.state);   x <- predict(x, u)

Source: Bryson & Ho, *Applied Optimal Control*, 12; Sola, *A micro Lie theory*, 2018.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.constraints.formulation import Formulation
from rbjax.dynamics.arguments import check_model, check_step, check_takes
from rbjax.estimation.kalman import StateSpace
from rbjax.model import Model, State
from rbjax.motion.field import Dynamics, dynamics_of, free_motion
from rbjax.motion.integrators import Integrator, integrator_of
from rbjax.motion.linearise import box_minus, box_plus, step


def model_state_space(
    model: Model,
    read: Callable[[State], jax.Array],
    dt: Any = None,
    *,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics = free_motion,
    constraints: str | Formulation | None = None,
) -> StateSpace:
    """Build the state space of a Kalman filter from a model: steps of `rollout`, each followed by
    noise w (2 nv + nx,) on the tangent space, and measurements y = read(state) + e.

    Args:
        model: the robot.
        read: a function of a state that returns (m,).
        dt: seconds; the model's timestep if None.
        integrator, dynamics, constraints: as in `rb.step`.

    Returns:
        `StateSpace`, for `kalman_update`, `kalman_predict` and `kalman_filter`.

    Raises:
        InputError: not a model, or `read` is not a function of a state.

    Source: Sola, *A micro Lie theory*, 2018.

    Example:
        >>> import jax.numpy as jnp, rbjax as rb
        >>> from rbjax.estimation import Estimate, kalman_update, model_state_space
        >>> model = rb.load("pendulum")
        >>> space = model_state_space(model, lambda state: state.q, 0.01)
        >>> guess = Estimate(model.default_state(), jnp.eye(2))
        >>> kalman_update(space, guess, jnp.array([0.2]), [1e-4]).state.q.shape
        (1,)
    """
    check_model("model_state_space", model)
    check_takes("model_state_space", "read", read, "state")
    if dt is not None:
        check_step("model_state_space", "dt", dt, jnp.zeros(()).dtype)
    integrator_of(
        "model_state_space",
        integrator,
        dynamics_of("model_state_space", model, dynamics, constraints),
    )

    def move(state: State, ctrl: Any, w: jax.Array) -> State:
        new = step(
            model,
            state,
            ctrl,
            dt,
            integrator=integrator,
            dynamics=dynamics,
            constraints=constraints,
        )
        return box_plus(model, new, w)

    return StateSpace(
        move, lambda state, y: y - read(state), functools.partial(box_plus, model),
        functools.partial(box_minus, model),
    )  # fmt: skip
