"""State spaces of Kalman filters: of arrays, and of a model on the tangent space of its states.

`kalman_update` and `kalman_predict` are the two halves of a filter. A control loop calls them
before and after the controller:

    x <- update(x, y);   u = controller(t, x.state);   x <- predict(x, u)

Source: Bryson & Ho, *Applied Optimal Control*, 12; Sola, *A micro Lie theory*, 2018.
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_array, shown
from rbjax.constraints.formulation import Formulation
from rbjax.display import displayed
from rbjax.dynamics.arguments import check_model, check_step, check_takes
from rbjax.errors import InputError
from rbjax.model import Model, State
from rbjax.motion.field import Dynamics, dynamics_of, free_motion
from rbjax.motion.integrators import Integrator, integrator_of
from rbjax.motion.linearise import box_minus, box_plus
from rbjax.motion.step import step


def matrix(name: str, x: Any, where: str = "kalman_filter") -> jax.Array:
    x = real(where, name, x, "variances (n,) or a matrix (n, n), of finite numbers")
    if x.ndim == 1:
        return jnp.diag(x)
    if x.ndim != 2 or x.shape[0] != x.shape[1]:
        raise InputError(
            f"{where}: {name} has shape {x.shape}, expected variances (n,) or a matrix (n, n)"
        )
    return x


def real(where: str, name: str, x: Any, expected: str, *, finite: bool = True) -> jax.Array:
    """Convert x to a floating-point array. Values that are not traced must be real numbers."""
    if not isinstance(x, jax.core.Tracer):
        dtype = getattr(x, "dtype", None)
        x = real_array(where, name, x, expected, finite=finite)
        if np.isinf(x).any():
            raise InputError(f"{where}: {name} has infinite numbers, expected {expected}")
        dtype = dtype if dtype is not None and jnp.issubdtype(dtype, jnp.floating) else None
        return jnp.asarray(x, float if dtype is None else dtype)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)


def check_fits(where: str, space: Any, state: Any, P: jax.Array, given: Any, W: Any) -> None:
    """Raise InputError if the shapes of state, covariance P and process noise W do not match.
    Only a `StateSpace` of arrays is checked. given: the inputs of a step. W: None for an update."""
    if space.box_plus is not operator.add:
        return
    shape = jnp.shape(state)
    if shape != P.shape[:1]:
        raise InputError(
            f"{where}: the state has shape {shape} and its covariance {P.shape}, expected (n,) and "
            "(n, n)"
        )
    if W is None:
        return
    new = jax.eval_shape(space.move, state, given, jnp.zeros(W.shape[0], W.dtype))
    if getattr(new, "shape", None) != shape:
        raise InputError(
            f"{where}: move makes {getattr(new, 'shape', type(new).__name__)} of a state {shape} "
            f"with noise of shape {W.shape[:1]}, expected {shape}: process has one variance for "
            "each entry of w"
        )


def check_inputs(where: str, inputs: Any, samples: bool) -> None:
    """Raise InputError unless inputs are numeric arrays, with one row a step if `samples`."""
    expected = "arrays (N, ...), one row a step" if samples else "arrays of numbers"
    for x in jax.tree.leaves(inputs):
        numeric = isinstance(x, jax.Array) or np.asarray(x).dtype.kind in "biuf"
        if not numeric or (samples and 0 in (*jnp.shape(x), jnp.ndim(x))):
            raise InputError(f"{where}: inputs contain {shown(x)}, expected {expected}")


def _difference(x0: jax.Array, x1: jax.Array) -> jax.Array:
    return x1 - x0


def _subtracted(read: Callable[[Any], jax.Array]) -> Callable[[Any, jax.Array], jax.Array]:
    return lambda x, y: y - read(x)


SPACE = "a StateSpace, as StateSpace.of(move, read)"


@displayed
class StateSpace(NamedTuple):
    """A discrete model with noise, for states that are arrays (n,) or points of a manifold.

    move: (x, u, w) -> the next state.
    innovation: (x, y) -> y (-) h(x), (m,).
    box_plus: (x, dx) -> x (+) dx.
    box_minus: (x0, x1) -> x1 (-) x0, (n,).

    Example:
        >>> from rbjax.estimation import StateSpace
        >>> walk = StateSpace.of(lambda x, u, w: x + u + w, lambda x: x)
        >>> walk.innovation(1.0, 3.0)
        2.0
    """

    move: Callable[[Any, Any, jax.Array], Any]
    innovation: Callable[[Any, Any], jax.Array]
    box_plus: Callable[[Any, jax.Array], Any] = operator.add
    box_minus: Callable[[Any, Any], jax.Array] = _difference

    @classmethod
    def of(cls, move: Callable, read: Callable) -> StateSpace:
        """Build the state space x' = move(x, u, w), y = read(x) + e of arrays x and y."""
        return cls(move, _subtracted(read))


def model_state_space(
    model: Model,
    read: Callable[[State], jax.Array],
    dt: Any = None,
    *,
    integrator: str | Integrator | None = None,
    dynamics: Dynamics = free_motion,
    constraints: str | Formulation | None = None,
) -> StateSpace:
    """Build the state space of a Kalman filter from a model.

    A step is a step of `rb.step`, followed by noise w (2 nv + nx,) on the tangent space.
    Measurements are y = read(state) + e.

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
    at = "model_state_space"
    integrator_of(at, integrator, dynamics_of(at, model, dynamics, constraints), model)

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
