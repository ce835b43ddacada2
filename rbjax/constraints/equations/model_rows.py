"""The constraint rows of a model: their gradients and residuals, and the forces of multipliers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike
from rbjax.constraints.rows.row import Row
from rbjax.display import displayed
from rbjax.dynamics.algorithms.rnea import LinkForces, add_forces
from rbjax.dynamics.drivers.choice import Driver
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.element import Loads
from rbjax.lanes import Lane, add, fusion_barrier, is_zero
from rbjax.lanes.arrays import pack
from rbjax.model import Model, State
from rbjax.spatial import Force


def rows_of(model: Model, context: Context) -> list[Row]:
    """Return the rows of all constraints of the model, in the order of the constraints."""
    out: list[Row] = []
    for constraint in model.constraints:
        rows = list(constraint.rows(context))
        if len(rows) != constraint.size:
            raise InputError(
                f"{type(constraint).__name__}.rows returned {len(rows)} rows, expected its size, "
                f"{constraint.size}"
            )
        for row in rows:
            if not isinstance(row, Row):
                raise InputError(
                    f"{type(constraint).__name__}.rows returned a {type(row).__name__} among its "
                    "rows, expected a Row: rbjax.constraints.coordinate and others make them"
                )
        out += [_compute_once(row, context) for row in rows]
    return out


def _compute_once(row: Row, context: Context) -> Row:
    """Return the row with its lanes behind a fusion barrier, to compute them only once."""
    known = (context.q, context.v, context.a, context.t)
    parts = row.value, row.rate, row.acceleration, row.gradient.tau, row.gradient.wrenches
    value, rate, acceleration, tau, wrenches = fusion_barrier(parts, known=known)
    return Row(value, rate, Loads(tau, wrenches, row.gradient.internal), acceleration)


def wrenches_by_link(loads: Loads) -> Mapping[int, Force]:
    """Return the wrenches of a row's gradient by link index."""
    if isinstance(loads.wrenches, Force):
        raise InputError("a row's gradient has wrenches on all links, expected those on a few")
    return loads.wrenches


def gradient_by_dof(context: Context, row: Row) -> dict[int, Lane]:
    """Compute the nonzero entries of a row's gradient by dof index."""
    out = dict(row.gradient.tau)
    for link, force in wrenches_by_link(row.gradient).items():
        for i, x in context.link(link).arms(force).items():
            out[i] = add(out.get(i, 0.0), x)
    return out


def gradient_matrix(context: Context, rows: Sequence[Row]) -> jax.Array:
    """Compute the gradient G (rows, nv) of the given rows."""
    out = jnp.zeros((len(rows), context.model.nv), context.q.dtype)
    for r, row in enumerate(rows):
        found = {i: x for i, x in gradient_by_dof(context, row).items() if not is_zero(x)}
        if found:
            out = out.at[r, np.array(list(found))].set(pack(list(found.values()), context.v))
    return out


def add_multipliers(
    d: Driver, rows: Sequence[Row], l: Sequence[Lane], tau: jax.Array, f_ext: LinkForces
) -> tuple[jax.Array, LinkForces]:
    """Add the constraint forces G^T l to generalized forces (nv,) and to forces on links."""
    total = sum((row.gradient * x for row, x in zip(rows, l, strict=True)), Loads())
    return tau + d.pack(d.scattered(total.tau, 0.0), tau), add_forces(f_ext, total.wrenches)


@displayed
class Residual(NamedTuple):
    """Residuals of the rows of a model.

    Fields:
        value: (m,) g; zero for non-holonomic rows.
        rate: (m,) G v + g_t.
    """

    value: jax.Array
    rate: jax.Array


@algorithm("state", "t")
def residual(model: Model, state: State, t: Any = 0.0) -> Residual:
    """Compute the constraint residuals at a state: g(t, q) and g' = G v + g_t.

    Args:
        model: the robot, with constraints.
        state: `State(q (nq,), v (nv,))`.
        t: time in seconds, for rows that depend on time.

    Returns:
        `Residual(value (m,), rate (m,))`. Values are in m, or dimensionless for angles.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> loop = rb.constraints.Inline.between(model, None, "lower", point=[0.0, 0, -2.0])
        >>> model = model.with_constraints(loop)
        >>> rb.constraints.residual(model, model.default_state()).value.shape
        (2,)
    """
    rows = rows_of(model, Context.of(model, t, state, None))
    values, rates = [row.residual for row in rows], [row.rate for row in rows]
    return Residual(pack(values, state.v), pack(rates, state.v))


@algorithm("q", "t")
def jacobian(model: Model, q: ArrayLike, t: Any = 0.0) -> jax.Array:
    """Compute the constraint Jacobian G (m, nv) of g' = G v + g_t.

    Args:
        model: the robot, with constraints.
        q: (nq,) configuration.
        t: time in seconds, for rows that depend on time.

    Returns:
        (m, nv), in the units of the rows per unit of velocity, SI.

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("double_pendulum")
        >>> rod = rb.constraints.Distance.between(model, None, "lower", point=[0.3, 0.0, 0.0],
        ...     other=[0.0, 0.0, 0.4])
        >>> rb.constraints.jacobian(model.with_constraints(rod), model.default_state().q).shape
        (1, 2)
    """
    context = Context.of(model, t, State(q, jnp.zeros(model.nv, q.dtype)), None)
    return gradient_matrix(context, rows_of(model, context))
