"""The law of constrained motion: accelerations and multipliers from forces.

    M a + b = tau + sum of J_i^T f_i + G^T l
    G a + (G' v + ...) = -2 alpha (G v + g_t) - beta^2 g

Its derivative is that of these equations (one tangent of RNEA and of the rows, one solve with the
factors that the value has left), so no factorization and no iteration is differentiated. Where rows
are redundant, a and its derivative are those of the rows that are left; the derivative of l is the
one of least norm. (Masarati, *Multibody System Dynamics*, ch. 7, 8; Baumgarte 1972.)
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.constraints.row import Row
from rbjax.constraints.system import response, rows_of
from rbjax.dynamics.aba import aba
from rbjax.dynamics.drivers import driver
from rbjax.dynamics.link_forces import LinkForces, added
from rbjax.dynamics.rnea import rnea
from rbjax.dynamics.tracing import split_tracers, with_implicit_jvp
from rbjax.forces.element import Loads
from rbjax.forces.instant import Instant
from rbjax.lanes import Lane, add, mul, sub
from rbjax.model import Model, State


def constrained_motion(
    model: Model,
    t: Any,
    state: State,
    tau: jax.Array,
    pushes: LinkForces,
    alpha: Any = 0.0,
    beta: Any = 0.0,
) -> tuple[jax.Array, jax.Array]:
    """a (nv,) and l (rows,) of a sample, on checked arrays."""
    given, rebuilt = split_tracers((model, pushes, t, alpha, beta))
    known_model = not split_tracers(model)[0]
    nv = model.nv

    def run(changed, q, v, tau, values=False):
        model, pushes, t, alpha, beta = rebuilt(changed)
        d = driver(model, q.dtype, values=values)
        now = Instant.of(model, t, State(q, v), None, d=d)
        qdd, factors = aba(d, now.links.joints, d.lanes(tau), d.prepared.gravity, pushes)
        free = d.pack(qdd, tau)
        now = now.accelerating(free)
        rows = rows_of(model, now)
        answer = response(d, factors, now, rows)
        l = answer.multipliers([asked(row, alpha, beta) for row in rows])
        a = free + answer.accelerated(None, l)
        return jnp.concatenate([a, _stacked(l, a)]), answer

    def plain(changed, q, v, tau):
        return run(changed, q, v, tau, values=known_model)[0]

    def solved(changed, q, v, tau):
        x, answer = run(changed, q, v, tau)

        def solve(change):
            force, off = change[:nv], change[nv:]
            reached = answer.projected(force)
            l = answer.multipliers([sub(off[r], y) for r, y in enumerate(reached)])
            return jnp.concatenate([answer.accelerated(force, l), _stacked(l, force)])

        return x, solve

    def residual(changed, q, v, tau, x):
        model, pushes, t, alpha, beta = rebuilt(changed)
        a, l = x[:nv], x[nv:]
        d = driver(model, q.dtype)
        now = Instant.of(model, t, State(q, v), None, d=d).accelerating(a)
        rows = rows_of(model, now)
        held = sum((row.gradient * l[r] for r, row in enumerate(rows)), Loads())
        forces = rnea(
            d, now.links.joints, d.lanes(a), d.prepared.gravity, added(pushes, held.wrenches)
        )
        left = tau + d.pack(d.scattered(held.tau, 0.0), tau) - d.pack(forces, tau)
        return jnp.concatenate([left, _stacked([asked(row, alpha, beta) for row in rows], a)])

    found = with_implicit_jvp(plain, solved, residual)(given, state.q, state.v, tau)
    return found[:nv], found[nv:]


def asked(row: Row, alpha: Any, beta: Any) -> Lane:
    """What a row asks of G times the change of a: -g'' - 2 alpha g' - beta^2 g."""
    out = add(row.acceleration, mul(mul(2.0, alpha), row.rate))
    if row.holonomic:
        out = add(out, mul(mul(beta, beta), row.value))
    return sub(0.0, out)


def _stacked(lanes: list[Lane], like: jax.Array) -> jax.Array:
    return jnp.stack([jnp.asarray(x, like.dtype) for x in lanes])
