"""A consistent state from a rough guess.

    min |dq|_M:  g(t, q + dq) = 0,  pinned coordinates held;     then the same for velocities
Gauss-Newton steps of least norm, each shortened until the residual decreases. The rows of a weld
and of a prismatic joint use the sine of half the angle (`HalfAngle`), so the steps do not converge
to a configuration that is half a turn off.
(Masarati, *Multibody System Dynamics*, ch. 6; Haug, *Computer-Aided Kinematics and Dynamics*, 4.6)
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_number, shown
from rbjax.constraints.analysis.rank import row_names
from rbjax.constraints.equations.residuals import jacobian, residual
from rbjax.constraints.methods.soft import Soft
from rbjax.constraints.rows.pairs import HalfAngle, Pair
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.dynamics.arguments import check_arrays
from rbjax.errors import InputError, listed
from rbjax.model import Model, State

STEPS, HALVINGS = 60, 12
#: the least singular value that a step uses, relative to the largest one, in f64 and in f32
LEAST = 1e-9, 1e-5
#: how far a guess is moved, rad or m, if its residual or Jacobian is NaN, as at half a turn
MOVED = 0.03


class Assembly(NamedTuple):
    """Fields: state; ok, whether it is on the constraints; off, the largest residual of values and
    rates; conflicting, the rows that are not met, by name."""

    state: State
    ok: bool
    off: float
    conflicting: tuple[str, ...]


def assemble(
    model: Model,
    state: State,
    t: Any = 0.0,
    *,
    pinned: Iterable[str] = (),
    tolerance: float | None = None,
    throw: bool = True,
) -> Assembly:
    """The state on the constraints that is nearest to a guess, in the norm of the mass matrix.

    Args:
        model: the robot, with constraints.
        state: the guess, `State(q (nq,), v (nv,))`.
        t: time in seconds, for rows that look at it.
        pinned: names of joints whose coordinates and velocities stay.
        tolerance: largest residual; 1e-12 in f64, 1e-5 in f32 if None.
        throw: raise where no state is found; otherwise `ok` and `conflicting` say so.

    Returns:
        `Assembly`. It is made outside of traced code and is not differentiated; for the derivative
        of a state that depends on numbers of the model put the result through
        `rb.constraints.Projection(iterations=8).project`.

    Raises:
        InputError: no such state, with the rows that conflict. UnknownName: no such joint.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("double_pendulum")
        >>> tip = rb.constraints.Inplane.between(model, None, "lower", point=[0, 0, 1.2])
        >>> found = rb.constraints.assemble(
        ...     model.with_constraints(tip), rb.State(jnp.array([0.5, 0.0]), jnp.zeros(2))
        ... )
        >>> found.ok
        True
    """
    state = check_arrays("assemble", model, {"state": state})["state"]
    dtype = state.q.dtype
    if tolerance is None:
        tolerance = 1e-12 if dtype == jnp.float64 else 1e-5
    real_number("assemble", "tolerance", tolerance, "a number above zero", above=0.0, traced=True)
    free = np.ones(model.nv, bool)
    if isinstance(pinned, str) or not isinstance(pinned, Iterable):
        raise InputError(
            f"assemble: pinned is {shown(pinned)}, expected names of joints, as ('elbow',)"
        )
    for name in pinned:
        free[model.v_slice(name)] = False
    model, whole = _half_angles(model), model
    rounding = LEAST[0] if dtype == jnp.float64 else LEAST[1]
    root = np.linalg.cholesky(np.asarray(mass_matrix(model, state.q), float)[np.ix_(free, free)])

    def least(off: np.ndarray, q: Any) -> np.ndarray:
        """The change of least norm that takes away what the free coordinates can."""
        G = np.asarray(jacobian(model, q, t), float)[:, free]
        change = np.zeros(model.nv)
        scaled = np.linalg.pinv(np.linalg.solve(root, G.T).T, rcond=rounding) @ -off
        change[free] = np.linalg.solve(root.T, scaled)
        return change

    q, v = state.q, state.v
    off = np.asarray(residual(model, state, t).value, float)
    random = np.random.default_rng(0)
    for _ in range(HALVINGS):
        if np.isfinite(np.c_[off, np.asarray(jacobian(model, q, t))]).all():
            break
        away = np.where(free, random.uniform(-MOVED, MOVED, model.nv), 0.0)
        q = integrate(model, state.q, jnp.asarray(away, dtype))
        off = np.asarray(residual(model, State(q, v, state.x), t).value, float)
    else:
        raise InputError(
            "assemble: the residual or its Jacobian is not a number at the guess, nor near it; "
            "expected a state at which every row is defined"
        )
    for _ in range(STEPS):
        if np.abs(off).max(initial=0.0) <= 0.01 * tolerance:
            break
        dq, length = least(off, q), 1.0
        for _ in range(HALVINGS):
            nearer = integrate(model, q, jnp.asarray(length * dq, dtype))
            left = np.asarray(residual(model, State(nearer, v, state.x), t).value, float)
            if np.linalg.norm(left) < np.linalg.norm(off):
                q, off = nearer, left
                break
            length /= 2
        else:
            break  # rounding, or a minimum that is no root
    for _ in range(2):
        rate = np.asarray(residual(model, State(q, v, state.x), t).rate, float)
        v = v + jnp.asarray(least(rate, q), dtype)
    found = State(q, v, state.x)
    value, rate = (np.abs(np.asarray(x, float)) for x in residual(model, found, t))
    worst = np.maximum(value, rate)
    names = [name for name, x in zip(row_names(whole), worst, strict=True) if not x <= tolerance]
    if names and throw:
        raise InputError(
            f"assemble: no state near the guess meets all rows; {listed(names, 6)} are off by up "
            f"to {worst.max():.2g}. Start nearer, pin less, or see rb.constraints.mobility"
        )
    return Assembly(found, not names, float(worst.max(initial=0.0)), tuple(names))


def _half_angles(model: Model) -> Model:
    """The model with `HalfAngle` rows for its loop joints: they are zero only if a joint is
    closed."""

    def of(constraint: Any) -> Any:
        joint = constraint.of if isinstance(constraint, Soft) else constraint
        return HalfAngle(joint) if isinstance(joint, Pair) and joint.turns else constraint

    return model.replace(constraints=tuple(of(x) for x in model.constraints))
