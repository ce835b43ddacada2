"""Mobility of a mechanism, and assembly of consistent states from a guess.

The mobility in one configuration is nv - rank(G). The rank is that of the scaled gradient
D^-1/2 G M^-1/2 with D = diag(G M^-1 G^T), so rows in metres and in radians are comparable.

`assemble` solves, for positions and then in the same way for velocities,

    min |dq|_M:  g(t, q + dq) = 0,  with constant pinned coordinates
by Gauss-Newton steps of least norm. A line search shortens each step until the residual decreases.
The rows of welds and prismatic joints are replaced by those of `HalfAngle`.

Source: Masarati, *Multibody System Dynamics*, ch. 6 and 8.5; Haug, *Computer-Aided Kinematics and
Dynamics*, 4.6; Wojtyra 2005.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, real_number, shown
from rbjax.constraints.equations.model_rows import jacobian, residual
from rbjax.constraints.rows.pairs import HalfAngle, Pair
from rbjax.constraints.rows.soft import Soft
from rbjax.display import displayed
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.dynamics.algorithms.manifold import integrate
from rbjax.dynamics.arguments import check_arrays
from rbjax.errors import InputError, listed
from rbjax.model import Model, State
from rbjax.rank_tolerances import rank_tolerance


@displayed
class Mobility(NamedTuple):
    """Degrees of freedom and redundant rows of a mechanism in one configuration.

    Fields:
        freedoms: number of degrees of freedom, nv - rank.
        rank: rank of the gradient G of the rows.
        singular_values: (m,) singular values of the scaled G, from 0 to sqrt(m).
        redundant: names of the rows that depend on rows before them.
    """

    freedoms: int
    rank: int
    singular_values: np.ndarray
    redundant: tuple[str, ...]


def row_names(model: Model) -> tuple[str, ...]:
    """Return the name of each row: its constraint, the constraint's index, and the row's index."""
    return tuple(
        f"{type(constraint).__name__} {n}, row {k}"
        for n, constraint in enumerate(model.constraints)
        for k in range(constraint.size)
    )


def mobility(
    model: Model, q: ArrayLike, t: Any = 0.0, *, tolerance: float | None = None
) -> Mobility:
    """Count the degrees of freedom of a constrained model in one configuration. Not traceable.

    Args:
        model: the robot, with constraints.
        q: (nq,) configuration.
        t: time in seconds, for rows that depend on time.
        tolerance: length below which the part of a scaled row that is orthogonal to the rows before
            it counts as zero, so that the row is redundant; 1e-7 in f64 and 1e-4 in f32 if None.

    Returns:
        `Mobility`, with the singular values of the scaled rows.

    Raises:
        InputError: a negative tolerance.

    Example:
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
    nonzero = lengths > tolerance * max(lengths.max(initial=0.0), np.finfo(float).tiny)
    B = np.where(nonzero[:, None], B / np.where(nonzero, lengths, 1.0)[:, None], 0.0)
    s = np.linalg.svd(B, compute_uv=False) if B.size else np.zeros(0)
    basis: list[np.ndarray] = []
    redundant = []
    for name, row in zip(row_names(model), B, strict=True):
        for e in (*basis, *basis):  # orthogonalize twice, against rounding
            row = row - (row @ e) * e
        size = np.linalg.norm(row)
        if size > tolerance:
            basis.append(row / size)
        else:
            redundant.append(name)
    return Mobility(model.nv - len(basis), len(basis), s, tuple(redundant))


STEPS, HALVINGS = 60, 12
#: largest random change of a guess with a NaN residual or Jacobian, as at half a turn; rad or m
MOVED = 0.03


@displayed
class Assembly(NamedTuple):
    """Result of `assemble`.

    Fields:
        state: the state.
        success: whether the state satisfies all constraints.
        off: largest absolute residual of values and rates.
        conflicting: names of the rows that are not satisfied.
    """

    state: State
    success: bool
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
    """Find the consistent state nearest to a guess, in the norm of the mass matrix. Not traceable.

    Args:
        model: the robot, with constraints.
        state: the guess, `State(q (nq,), v (nv,))`.
        t: time in seconds, for rows that depend on time.
        pinned: names of joints whose coordinates and velocities do not change.
        tolerance: largest allowed residual; 1e-12 in f64 and 1e-5 in f32 if None.
        throw: raise if no consistent state is found. If False, return `success` = False instead.

    Returns:
        `Assembly`. To differentiate a consistent state, apply
        `rb.constraints.Projection(iterations=8).project` to it.

    Raises:
        InputError: no consistent state was found. The message names the conflicting rows.
        UnknownName: a pinned joint is not in the model.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> model = rb.load("double_pendulum")
        >>> tip = rb.constraints.Inplane.between(model, None, "lower", point=[0, 0, 1.2])
        >>> found = rb.constraints.assemble(
        ...     model.with_constraints(tip), rb.State(jnp.array([0.5, 0.0]), jnp.zeros(2))
        ... )
        >>> found.success
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
        """Compute the least change of the free coordinates that reduces the linearised residual to
        zero."""
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
            break  # the limit of rounding, or a local minimum that is not a root
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
    """Replace welds and prismatic joints of a model by their `HalfAngle`."""

    def of(constraint: Any) -> Any:
        joint = constraint.of if isinstance(constraint, Soft) else constraint
        return HalfAngle(joint) if isinstance(joint, Pair) and joint.turns else constraint

    return model.replace(constraints=tuple(of(x) for x in model.constraints))
