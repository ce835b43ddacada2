"""Mobility of a mechanism: how many freedoms its constraints leave, and which rows say nothing new.

    freedoms = nv - rank(G),     G scaled, so that metres compare with radians: D^-1/2 G M^-1/2
with D = diag(G M^-1 G^T). The rank belongs to a configuration: a mechanism that is over-constrained
by design has redundant rows everywhere, one that passes a singular position has them there only.
(Masarati, *Multibody System Dynamics*, ch. 6; Wojtyra 2005)
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_number, shown
from rbjax.constraints.equations.model_rows import jacobian, residual
from rbjax.constraints.methods.soft import Soft
from rbjax.constraints.rows.pairs import HalfAngle, Pair
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.dynamics.arguments import check_arrays
from rbjax.errors import InputError, listed
from rbjax.model import Model, State
from rbjax.rank_tolerances import rank_tolerance


class Mobility(NamedTuple):
    """Fields: freedoms, nv - rank; rank; singular_values (m,) of the scaled G, which are between 0
    and the root of m; redundant, the rows that follow from those before them, by name."""

    freedoms: int
    rank: int
    singular_values: np.ndarray
    redundant: tuple[str, ...]


def row_names(model: Model) -> tuple[str, ...]:
    """What messages call the rows: the constraint, its place among them, and the row in it."""
    return tuple(
        f"{type(constraint).__name__} {n}, row {k}"
        for n, constraint in enumerate(model.constraints)
        for k in range(constraint.size)
    )


def mobility(
    model: Model, q: jax.Array, t: Any = 0.0, *, tolerance: float | None = None
) -> Mobility:
    """The freedoms that a model's constraints leave at a configuration.

    Args:
        model: the robot, with constraints.
        q: (nq,) configuration.
        t: time in seconds, for rows that depend on it.
        tolerance: a row, scaled to length one, is redundant if its part that is orthogonal to the
            rows before it is shorter than this; 1e-7 in f64 and 1e-4 in f32 if None.

    Returns:
        `Mobility`, of numbers and not of arrays: it is a report, and cannot be traced.

    Example: a door on two hinges
        >>> import rbjax as rb
        >>> model = rb.load("free_body")
        >>> hinges = [
        ...     rb.constraints.Revolute.between(model, None, 0, point=[0.0, 0.0, z]) for z in (0, 1)
        ... ]
        >>> found = rb.constraints.mobility(
        ...     model.with_constraints(*hinges), model.default_state().q
        ... )
        >>> found.freedoms, len(found.redundant)
        (1, 5)
    """
    rows = jacobian(model, q, t)
    if tolerance is not None:
        real_number("mobility", "tolerance", tolerance, least=0.0, traced=True)
    else:
        tolerance = rank_tolerance("mobility", rows.dtype)
    G = np.asarray(rows, float)
    root = np.linalg.cholesky(np.asarray(mass_matrix(model, q), float))
    B = np.linalg.solve(root, G.T).T
    lengths = np.linalg.norm(B, axis=1)
    said = lengths > tolerance * max(lengths.max(initial=0.0), np.finfo(float).tiny)
    B = np.where(said[:, None], B / np.where(said, lengths, 1.0)[:, None], 0.0)
    s = np.linalg.svd(B, compute_uv=False) if B.size else np.zeros(0)
    basis: list[np.ndarray] = []
    redundant = []
    for name, row in zip(row_names(model), B, strict=True):
        for e in (*basis, *basis):  # twice: once leaves rounding
            row = row - (row @ e) * e
        size = np.linalg.norm(row)
        if size > tolerance:
            basis.append(row / size)
        else:
            redundant.append(name)
    return Mobility(model.nv - len(basis), len(basis), s, tuple(redundant))


STEPS, HALVINGS = 60, 12
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
    rounding = rank_tolerance("assembly", dtype)
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
