"""Steps of fixed length on the manifold of configurations, for `rollout`. Batch last.

    semi-implicit Euler   v+ = v + h a(q, v),   q+ = q (+) h v+
    Runge-Kutta           q = q0 (+) u,   u' = J_r(u)^-1 v,   v' = a(q0 (+) u, v)

A Runge-Kutta method runs on the increments (u, v - v0), which are a vector space: its order is
that of its tableau, attitudes included (Munthe-Kaas 1998; Hairer, Lubich & Wanner, *Geometric
Numerical Integration*, IV.8). Controls are held over a step.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import diffrax
import jax
import jax.numpy as jnp

from rbjax.dynamics.forward import acceleration
from rbjax.dynamics.manifold import integrate_lanes, rate_lanes
from rbjax.forces.applied import applied
from rbjax.materialize import materialize
from rbjax.model import Model
from rbjax.solvers.dop853 import DOP853
from rbjax.solvers.steps import combine, explicit_stages, scaled
from rbjax.solvers.tableau import KUTTA4, Tableau, of_diffrax

#: stages times velocity coordinates up to which the stages of a step are written out
WRITTEN_UP_TO = 13

TABLEAUS = {
    "rk4": KUTTA4,
    "tsit5": of_diffrax(diffrax.Tsit5, 5).essential,
    "dopri8": of_diffrax(diffrax.Dopri8, 8).essential,
    "dop853": DOP853,
}


def _acceleration(model: Model, q, v, ctrl):
    batched = functools.partial(jax.vmap, in_axes=-1, out_axes=-1)
    force = functools.partial(applied, model)
    tau = (batched(force) if q.ndim > 1 else force)(q, v, ctrl)
    return acceleration(model, q, v, tau)


def _moved(model: Model, q: jax.Array, dq: jax.Array) -> jax.Array:
    return jnp.stack(materialize(integrate_lanes(model.topology, list(q), list(dq))))


def _rate(model: Model, u: jax.Array, v: jax.Array) -> jax.Array:
    """u' of the increment u, where the configuration moves at v."""
    if not model.topology.turn_starts:
        return v
    return jnp.stack(materialize(rate_lanes(model.topology, list(u), list(v))))


def semi_implicit_euler(model: Model, q, v, ctrl, dt):
    """v+ = v + dt a(q, v);  q+ = q (+) dt v+. First order; symplectic where the mass matrix is
    constant and no force depends on v, not for a mass matrix that moves with q."""
    v = v + dt * _acceleration(model, q, v, ctrl)
    return _moved(model, q, dt * v), v


def runge_kutta(table: Tableau, model: Model, q, v, ctrl, dt):
    """A step of an explicit tableau; its stages are written out, or a loop where they are many."""

    def rate(t, k):
        u, w = k[0], v + k[1]
        return _rate(model, u, w), _acceleration(model, _moved(model, q, u), w, ctrl)

    written = table.stages * model.nv <= WRITTEN_UP_TO
    stages = explicit_stages(rate, table, 0 * dt, dt, written=written)
    u, dv = scaled(dt, combine(table.b, stages((jnp.zeros_like(v), jnp.zeros_like(v)))))
    return _moved(model, q, u), v + dv


INTEGRATORS: dict[str, Callable[..., Any]] = {"semi_implicit_euler": semi_implicit_euler}
INTEGRATORS |= {name: functools.partial(runge_kutta, t) for name, t in TABLEAUS.items()}
