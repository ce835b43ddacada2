"""The measured order of a solver's code: errors on a smooth problem, with halved steps.

    error(h) ~ C h^p,    p = log2(error(h) / error(h / 2))
Methods for vector fields and for pairs q' = v, v' = a are measured on a driven damped pendulum,
Lie-group methods on a rigid body under a torque. The reference is SciPy's Dormand-Prince 8 in
NumPy.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.integrate import solve_ivp

from rbjax.errors import InputError
from rbjax.solvers import (
    CommutatorFree4,
    CrouchGrossman3,
    MuntheKaas,
    RigidBody,
    RigidBodySplitting,
    Tableau,
)
from rbjax.stability.methods import Solver, stepping

END = 2.0
INERTIA = np.array([1.0, 2.0, 3.5])
COARSEST, FINEST = 8, 8192
SMALL, LARGE = 1e-11, 1e-2  # errors at which rounding, or higher powers of h, matter
ON_GROUPS = (MuntheKaas, CrouchGrossman3, CommutatorFree4, RigidBodySplitting)


@dataclass(frozen=True)
class MeasuredOrder:
    """order, the mean over the two finest halvings; steps and errors of all runs."""

    order: float
    steps: tuple[int, ...]
    errors: tuple[float, ...]


def _pendulum(t: Any, y: Any, args: Any) -> Any:
    q, v = y
    return v, -2.0 * jnp.sin(q) + 0.5 * jnp.cos(t) - 0.3 * v


def _plain_pendulum(t: float, y: np.ndarray) -> np.ndarray:
    return np.array([y[1], -2.0 * np.sin(y[0]) + 0.5 * np.cos(t) - 0.3 * y[1]])


def _torque(t: Any, turn: Any, args: Any) -> Any:
    return 0.5 * jnp.sin(t) * jnp.array([1.0, 0.0, 0.5])


def _plain_body(t: float, y: np.ndarray) -> np.ndarray:
    w, x, y_, z = y[:4]
    a, b, c = rate = y[4:]
    turn = [-x * a - y_ * b - z * c, w * a + y_ * c - z * b, w * b + z * a - x * c,
            w * c + x * b - y_ * a]  # fmt: skip
    torque = 0.5 * np.sin(t) * np.array([1.0, 0.0, 0.5])
    return np.concatenate(
        [0.5 * np.array(turn), (np.cross(INERTIA * rate, rate) + torque) / INERTIA]
    )


@functools.cache
def _problem(on_group: bool) -> tuple[Any, Any, np.ndarray]:
    """Term, initial state, and the state at the end."""
    if on_group:
        start = np.array([1.0, 0.0, 0.0, 0.0]), np.array([0.5, 1.0, -0.7])
        term, plain = RigidBody(INERTIA, _torque), _plain_body
    else:
        start = np.array([1.0]), np.array([0.3])
        term, plain = diffrax.ODETerm(_pendulum), _plain_pendulum  # type: ignore[assignment]
    found = solve_ivp(
        plain, (0.0, END), np.concatenate(start), method="DOP853", rtol=3e-14, atol=1e-14
    )
    return term, start, found.y[:, -1]


@eqx.filter_jit
def _end(term: Any, solver: Any, start: Any, steps: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The state after `steps` equal steps, and whether all succeeded."""
    found = diffrax.diffeqsolve(
        term, solver, 0.0, END, END / steps * (1 + 1e-12), start, throw=False, max_steps=None,
        stepsize_controller=diffrax.ConstantStepSize(), adjoint=diffrax.ForwardMode(),
    )  # fmt: skip
    last = jnp.concatenate([x[-1] for x in jax.tree.leaves(found.ys)])
    return last, found.result == diffrax.RESULTS.successful


def measured_order(solver: Solver) -> MeasuredOrder:
    """The order of a solver on a smooth problem, measured over halvings of the step.

    Args:
        solver: a name of `rb.solvers.all()` or a diffrax solver, of any vector field, of
            q' = v, v' = a, or on Lie groups, or an `rb.solvers.Tableau`. A root finder whose
            tolerances are a controller's is replaced by `rb.solvers.very_chord()`.

    Returns:
        `MeasuredOrder`: the order, and the steps and errors behind it.

    Raises:
        UnknownName: an unknown name.
        InputError: a method without code; no two halvings have errors that are neither rounding nor
            too large.

    Source: Hairer, Norsett & Wanner, *Solving ODEs I*, II.4.

    Example:
        >>> import rbjax as rb
        >>> round(rb.stability.measured_order("rk4").order, 1)
        4.0
    """
    own = isinstance(solver, Tableau)  # its order is for vector fields
    solver = stepping(solver)
    steps: list[int] = []
    errors: list[float] = []
    n = COARSEST
    with jax.enable_x64(True):
        term, start, truth = _problem(not own and isinstance(solver, ON_GROUPS))
        while n <= FINEST and (not errors or not errors[-1] < SMALL):
            y, ok = _end(term, solver, start, jnp.array(float(n)))
            steps.append(n)
            errors.append(float(np.abs(np.asarray(y) - truth).max()) if ok else np.inf)
            n *= 2
    good = [e for e in errors if SMALL / 100 < e < LARGE]
    if len(good) < 3:
        raise InputError(
            f"measured_order: {type(solver).__name__} has errors {errors} after {steps} steps, "
            f"expected three between {SMALL / 100:.0e} and {LARGE:.0e}"
        )
    rates = np.log2(np.divide(good[:-1], good[1:]))
    return MeasuredOrder(float(rates[-2:].mean()), tuple(steps), tuple(errors))
