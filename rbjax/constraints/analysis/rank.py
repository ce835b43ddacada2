"""Mobility of a mechanism: how many freedoms its constraints leave, and which rows say nothing new.

    freedoms = nv - rank(G),     G scaled, so that metres compare with radians: D^-1/2 G M^-1/2
with D = diag(G M^-1 G^T). The rank belongs to a configuration: a mechanism that is over-constrained
by design has redundant rows everywhere, one that passes a singular position has them there only.
(Masarati, *Multibody System Dynamics*, ch. 6; Wojtyra 2005)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_number
from rbjax.constraints.equations.residuals import jacobian
from rbjax.dynamics.algorithms.crba import mass_matrix
from rbjax.model import Model


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
        tolerance = 1e-7 if rows.dtype == jnp.float64 else 1e-4
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
