"""Motion in the coordinates of the tangent space at a step's start: the minimal family.

Near a state (q_0, v_0) on the constraints others are known by how far they are along the rows'
null space there, Z (G_0 Z = 0), and are found by Newton's method across it, along M_0^-1 G_0^T:

    q = q_0 (+) u,   Z^T M_0 u = z,   g(t, q) = 0;        Z^T M_0 v = s,   G v + g_t = 0
A step is one of the ordinary differential equations of z and s (z' = s, where joints do not turn
bodies freely): the forces of each of its stages are those of a state on the constraints. A method
of Runge and Kutta makes z from u' and s from v' as Z^T M_0 makes them, and what they have across Z
is found again: it never enters. So u and v are integrated as they are, and Z is never made.

(Mani, Haug & Atkinson 1985; Potra & Rheinboldt 1991; Hairer, Lubich & Wanner, *Geometric Numerical
Integration*, IV.5.3; Masarati 7.1.3)
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.equations.least_change import (
    Changes,
    Solve,
    least_changes,
    leveled,
    off,
    off_of,
)
from rbjax.constraints.equations.system import OnMatrices, gradient_matrix, least_norm, rows_of
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import factorize
from rbjax.dynamics.algorithms.aba import solve as solved
from rbjax.dynamics.algorithms.manifold import difference_lanes, retract, velocity_lanes
from rbjax.dynamics.drivers.choice import Driver
from rbjax.dynamics.drivers.packing import pack
from rbjax.forces.context import Context
from rbjax.lanes.arrays import matmat, matvec
from rbjax.lanes.factorization import least
from rbjax.model import Model, State

#: of Newton's method, by bytes of a number: from the error of a stage, below 0.1, to rounding
ITERATIONS = {4: 3, 8: 5}


def across(
    model: Model, t: Any, state: State, t0: Any, start: State, iterations: int | None = None
) -> State:
    """The state on the constraints with the z and s of another, of the tangent space at `start`."""
    q, v, top = start.q, state.v, model.topology
    many = ITERATIONS[q.dtype.itemsize] if iterations is None else iterations
    u = pack(difference_lanes(top, list(q), list(state.q)), v)

    def method(
        d: Driver, model: Model, t0: Any, t: Any, q: jax.Array, u: jax.Array, v: jax.Array
    ) -> Changes:
        return _newton(d, model, t0, t, q, u, v, many)

    du, dv = least_changes(method, model, t0, t, q, u, v)
    return State(retract(model, q, u + du), v + dv, state.x)


def _newton(
    d: Driver,
    model: Model,
    t0: Any,
    t: Any,
    q: jax.Array,
    u: jax.Array,
    v: jax.Array,
    many: int,
) -> Changes:
    def seen(t: Any, u: jax.Array, v: jax.Array) -> tuple[Context, list[Row]]:
        now = Context.of(model, t, State(retract(model, q, u), v), None, d=d)
        return now, rows_of(model, now)

    first, rows = seen(t0, jnp.zeros_like(u), v)
    factors = factorize(d, first.links.joints)
    begun = OnMatrices(d, factors, first, rows)
    size, usual = jnp.diagonal(begun.A), begun.usual  # a row that vanishes stays short
    size = size + least(size, usual, 1.0)
    r = jnp.where(size > 0, 1.0, 0.0) / jnp.sqrt(jnp.where(size > 0, size, 1.0))

    def nearest(G: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
        """x = M_0^-1 G_0^T l, and l, of G x = c; of redundant rows the least l."""
        J = r[:, None] * matmat(G, begun.Y) * r
        l = r * matvec(J.T, least_norm(matmat(J, J.T), r * c, 1.0))
        return matvec(begun.Y, l), l

    level = np.array([row.holonomic for row in rows])

    def by_du(G: jax.Array, du: jax.Array) -> jax.Array:
        """The gradient of positions: attitudes turn by J_r(u) du; a row with only a rate
        keeps G_0."""
        back = list(-(u + du))
        turned = jax.vmap(lambda row: pack(velocity_lanes(model.topology, back, list(row)), row))
        return jnp.where(level[:, None], turned(G), begun.G)

    def nearer(_: Any, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        now, there = seen(t, u + x[0], v)
        left = leveled(first, rows, off_of(there, v)[0], x[0])
        more = nearest(by_du(gradient_matrix(now, there), x[0]), -left)
        return x[0] + more[0], x[1] + more[1]

    du, l = jnp.zeros_like(u), jnp.zeros(len(rows), u.dtype)
    if level.any():
        du, l = jax.lax.fori_loop(0, many, nearer, (du, l))
    G = gradient_matrix(*seen(t, u + du, v))

    def slower(_: Any, x: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        more = nearest(G, -off(d, model, t, q, u + du, v + x[0])[1])
        return x[0] + more[0], x[1] + more[1]

    def linear(G: jax.Array) -> Solve:
        def solve(force: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
            free = d.pack(solved(d, factors, d.lanes(force)), force)
            x, l = nearest(G, c - matvec(G, free))
            return free + x, l

        return solve

    dv, m = jax.lax.fori_loop(0, 2, slower, (jnp.zeros_like(v), jnp.zeros_like(l)))  # linear: twice
    return Changes(du, l, dv, m, linear(by_du(G, du)), linear(G))
