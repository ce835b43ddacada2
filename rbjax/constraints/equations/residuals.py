"""Residuals of the constraints at a state, and their Jacobian."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.system import gradient_matrix, rows_of
from rbjax.dynamics.drivers.packing import pack
from rbjax.dynamics.tracing.algorithm import algorithm
from rbjax.forces.context import Context
from rbjax.model import Model, State


class Residual(NamedTuple):
    """Rows (m,): values g, zero for non-holonomic rows, and rates G v + g_t."""

    value: jax.Array
    rate: jax.Array


@algorithm("state", "t")
def residual(model: Model, state: State, t: Any = 0.0) -> Residual:
    """The residuals of the constraints at a state: g(t, q) and g' = G v + g_t.

    Args:
        model: the robot, with constraints.
        state: `State(q (nq,), v (nv,))`.
        t: time in seconds, for rows that depend on it.

    Returns:
        `Residual(value (m,), rate (m,))`. A value is in m, or without unit for angles. A rate is
        that per second.

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
def jacobian(model: Model, q: jax.Array, t: Any = 0.0) -> jax.Array:
    """G (m, nv): g' = G v + g_t, row by row.

    Args:
        model: the robot, with constraints.
        q: (nq,) configuration.
        t: time in seconds, for rows that depend on it.
    """
    now = Context.of(model, t, State(q, jnp.zeros(model.nv, q.dtype)), None)
    return gradient_matrix(now, rows_of(model, now))
