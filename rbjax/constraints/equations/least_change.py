"""The least change, in the norm of the mass matrix, that puts a motion on its constraints.

    M dq = G^T l,   g(t, q_0 + u + dq) = 0
    M dv = G^T m,   G' (v + dv) + g_t = 0
M and G are those at (t_0, q_0); G' and g_t those at t and where the first line ends. A row that has
only a rate has G dq = 0 in the first line. `projection`
and `tangent` solve these equations by iterations of their own; the derivative, here, is that of the
equations, so no iteration and no factorization is differentiated.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.system import gradient_matrix, rows_of, with_multipliers
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.manifold import retract
from rbjax.dynamics.algorithms.rnea import rnea
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.drivers.packing import pack
from rbjax.dynamics.tracing.custom_rules import split_tracers, with_implicit_jvp
from rbjax.forces.context import Context
from rbjax.lanes import Vec3
from rbjax.lanes.arrays import matvec
from rbjax.model import Model, State

#: (force (nv,), c (rows,)) -> x (nv,), l (rows,) of M x = force + G^T l, G' x = c
Solve = Callable[[jax.Array, jax.Array], tuple[jax.Array, jax.Array]]
#: (driver, model, t_0, t, q_0, u, v) -> the changes
Method = Callable[..., "Changes"]


@dataclass(frozen=True)
class Changes:
    """dq, dv (nv,); l, m (rows,); and the solutions of equations that are linear in their changes,
    with G' at the end of each."""

    dq: jax.Array
    l: jax.Array
    dv: jax.Array
    m: jax.Array
    of_positions: Solve
    of_velocities: Solve


def least_changes(
    method: Method, model: Model, t0: Any, t: Any, q: jax.Array, u: jax.Array, v: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """dq and dv."""
    given, rebuilt = split_tracers((model, t0, t))
    nv = model.nv

    def found(changed, q, u, v):
        model, t0, t = rebuilt(changed)
        x = method(driver(model, q.dtype), model, t0, t, q, u, v)
        return (_joined(x.dq, x.l), _joined(x.dv, x.m)), x

    def plain(changed, q, u, v):
        return found(changed, q, u, v)[0]

    def solved(changed, q, u, v):
        values, x = found(changed, q, u, v)
        solves = x.of_positions, x.of_velocities
        return values, [lambda c, by=by: _joined(*by(c[:nv], c[nv:])) for by in solves]

    def begun(changed, q, v, x, l):
        """The driver, the instant and the rows at q, and G^T l - M x there."""
        model, t0, _ = rebuilt(changed)
        d = driver(model, q.dtype)
        now = Context.of(model, t0, State(q, v), None, d=d)
        rows = rows_of(model, now)
        tau, f_ext = with_multipliers(d, rows, list(l), jnp.zeros_like(x), {})
        needed = rnea(d, d.joints(q, None), d.lanes(x), Vec3.zero(), f_ext)
        return d, now, rows, tau - d.pack(needed, tau)

    def of_positions(changed, q, u, v, x):
        model, _, t = rebuilt(changed)
        dq = x[:nv]
        d, now, rows, force = begun(changed, q, v, dq, x[nv:])
        level, _ = off(d, model, t, q, u + dq, v)
        return _joined(force, -leveled(now, rows, level, dq))

    def of_velocities(changed, q, u, v, x, y):
        model, _, t = rebuilt(changed)
        dv = y[:nv]
        d, _, _, force = begun(changed, q, v, dv, y[nv:])
        _, rate = off(d, model, t, q, u + x[:nv], v + dv)
        return _joined(force, -rate)

    changes = with_implicit_jvp(plain, solved, of_positions, of_velocities)(given, q, u, v)
    return changes[0][:nv], changes[1][:nv]


def off(
    d: Driver, model: Model, t: Any, q: jax.Array, u: jax.Array, v: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """g and G v + g_t (rows,) at q + u."""
    now = Context.of(model, t, State(retract(model, q, u), v), None, d=d)
    return off_of(rows_of(model, now), v)


def off_of(rows: Sequence[Row], like: jax.Array) -> tuple[jax.Array, jax.Array]:
    """g and G v + g_t (rows,)."""
    return pack([row.residual for row in rows], like), pack([row.rate for row in rows], like)


def leveled(now: Context, rows: Sequence[Row], level: jax.Array, dq: jax.Array) -> jax.Array:
    """g, or G dq of a row that has only a rate, at `now`."""
    free = np.array([r for r, row in enumerate(rows) if not row.holonomic], int)
    if not free.size:
        return level
    G = gradient_matrix(now, [rows[r] for r in free])
    return level.at[free].set(matvec(G, dq))


def _joined(x: jax.Array, l: jax.Array) -> jax.Array:
    return jnp.concatenate([x, l])
