"""The law of constrained motion: accelerations and multipliers from forces.

    M a + b = tau + sum of J_i^T f_i + G^T l
    G a + (G' v + ...) = -2 alpha (G v + g_t) - beta^2 g

The equations are linear in a and l. A method says from which accelerations a_0 it starts and how
it solves for the rest:

    M da - G^T dl = tau + sum of J_i^T f_i - b - M a_0,     G da = c - (what the rows have at a_0)

The derivative is that of these equations (one tangent of RNEA and of the rows, one more solution by
the same method), so no factorization and no iteration is differentiated. Where rows are redundant,
a and its derivative are those of the rows that are left; l is one of many.
(Masarati, *Multibody System Dynamics*, ch. 7, 8; Baumgarte 1972.)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.system import response, rows_of, with_multipliers
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import aba
from rbjax.dynamics.algorithms.link_forces import LinkForces
from rbjax.dynamics.algorithms.rnea import rnea
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.drivers.packing import pack
from rbjax.dynamics.tracing.custom_rules import split_tracers, with_implicit_jvp
from rbjax.forces.context import Context
from rbjax.lanes import Lane, add, mul, neg
from rbjax.model import Model, State

#: (force (nv,), or None for what the method leaves at a_0; c of the rows) -> da (nv,), dl (rows,)
Solve = Callable[[jax.Array | None, Sequence[Lane]], tuple[jax.Array, jax.Array]]
#: (instant, rows) -> how their equations are solved
System = Callable[[Context, Sequence[Row]], Solve]
#: (driver, instant, tau, f_ext) -> a_0 or None for zero, the forces left there or None if the
#: system knows them, the system
Method = Callable[
    [Driver, Context, jax.Array, LinkForces], tuple[jax.Array | None, jax.Array | None, System]
]

#: (instant, rows, l or None for zero, alpha, beta) -> residuals of the rows' equations
Left = Callable[[Context, Sequence[Row], jax.Array | None, Any, Any], Sequence[Lane]]


def range_space(
    d: Driver, now: Context, tau: jax.Array, f_ext: LinkForces
) -> tuple[jax.Array, None, System]:
    """From free motion on (no force is left): A dl = c - G M^-1 f, da = M^-1 (f + G^T dl)."""
    qdd, factors = aba(d, now.links.joints, d.lanes(tau), d.prepared.gravity, f_ext)

    def system(now: Context, rows: Sequence[Row]) -> Solve:
        return response(d, factors, now, rows).solved

    return d.pack(qdd, tau), None, system


def constrained_motion(
    model: Model,
    t: Any,
    state: State,
    tau: jax.Array,
    f_ext: LinkForces,
    alpha: Any = 0.0,
    beta: Any = 0.0,
    method: Method = range_space,
    left_of: Left | None = None,
) -> tuple[jax.Array, jax.Array]:
    """a (nv,) and l (rows,) of a sample, on checked arrays. `left_of`: of rows with another
    equation than that above, which `method` solves."""
    given, rebuilt = split_tracers((model, f_ext, t, alpha, beta))
    nv = model.nv

    def left_at(now, rows, l, alpha, beta):
        if left_of is not None:
            return list(left_of(now, rows, l, alpha, beta))
        return [asked(row, alpha, beta) for row in rows]

    def run(changed, q, v, tau):
        model, f_ext, t, alpha, beta = rebuilt(changed)
        d = driver(model, q.dtype)
        now = Context.of(model, t, State(q, v), None, d=d)
        start, left, system = method(d, now, tau, f_ext)
        now = now if start is None else now.accelerating(start)
        rows = rows_of(model, now)
        solve = system(now, rows)
        da, l = solve(left, left_at(now, rows, None, alpha, beta))
        a = da if start is None else start + da
        return jnp.concatenate([a, l]), solve

    def plain(changed, q, v, tau):
        return (run(changed, q, v, tau)[0],)

    def solved(changed, q, v, tau):
        x, solve = run(changed, q, v, tau)

        def solution(change):
            return jnp.concatenate(solve(change[:nv], list(change[nv:])))

        return (x,), [solution]

    def residual(changed, q, v, tau, x):
        model, f_ext, t, alpha, beta = rebuilt(changed)
        a, l = x[:nv], x[nv:]
        d = driver(model, q.dtype)
        now = Context.of(model, t, State(q, v), None, d=d).accelerating(a)
        rows = rows_of(model, now)
        joints = now.links.joints  # first: a driver learns from them what its lanes are
        tau, f_ext = with_multipliers(d, rows, list(l), tau, f_ext)
        forces = rnea(d, joints, d.lanes(a), d.prepared.gravity, f_ext)
        off = pack(left_at(now, rows, l, alpha, beta), a)
        return jnp.concatenate([tau - d.pack(forces, tau), off])

    (found,) = with_implicit_jvp(plain, solved, residual)(given, state.q, state.v, tau)
    return found[:nv], found[nv:]


def asked(row: Row, alpha: Any, beta: Any) -> Lane:
    """What a row asks of G times the change of a: -g'' - 2 alpha g' - beta^2 g."""
    out = add(row.acceleration, mul(mul(2.0, alpha), row.rate))
    return neg(add(out, mul(mul(beta, beta), row.residual)))
