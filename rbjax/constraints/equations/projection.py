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

from rbjax.constraints.equations.constrained_motion import OnMatrices, least_norm, response
from rbjax.constraints.equations.model_rows import gradient_matrix, rows_of, with_multipliers
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import factorize
from rbjax.dynamics.algorithms.aba import solve as solved
from rbjax.dynamics.algorithms.manifold import difference_lanes, retract, velocity_lanes
from rbjax.dynamics.algorithms.rnea import rnea
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.custom_rules import jax_arrays, split_tracers, with_implicit_jvp
from rbjax.forces.context import Context
from rbjax.lanes import Vec3, batch_first
from rbjax.lanes.arrays import matmat, matvec, pack
from rbjax.lanes.factorization import diagonal_floor
from rbjax.model import Model, State
from rbjax.rank_tolerances import rank_tolerance

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

    def plain(*at):
        return batch_first(found(*at)[0], at)

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

    solution = with_implicit_jvp(plain, solved, of_positions, of_velocities)
    changes = solution(*jax_arrays(given, q, u, v))
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


#: x (nv,) -> what rows are off by (rows,)
Residual = Callable[[jax.Array], jax.Array]
#: by bytes of a number
ITERATIONS = {4: 1, 8: 2}


def projected(
    model: Model, t: Any, state: State, iterations: int | None = None, positions: bool = True
) -> State:
    """The state on its constraints. iterations None: as many as bring the error of a step down to
    rounding. `positions`: not only its velocity."""
    q, v = state.q, state.v
    many = ITERATIONS[q.dtype.itemsize] if iterations is None else iterations

    def method(d: Driver, model: Model, _: Any, t: Any, q: jax.Array, u: Any, v: Any) -> Changes:
        return _projection(d, model, t, q, v, many, positions)

    dq, dv = least_changes(method, model, t, t, q, jnp.zeros_like(v), v)
    return State(retract(model, q, dq) if positions else q, v + dv, state.x)


def _projection(
    d: Driver, model: Model, t: Any, q: jax.Array, v: jax.Array, many: int, positions: bool
) -> Changes:
    now = Context.of(model, t, State(q, v), None, d=d)
    rows = rows_of(model, now)
    answer = response(
        d, factorize(d, now.links.joints), now, rows, rank_tolerance("projection", q.dtype)
    )

    def iterated(f: Residual, begun: jax.Array, force: Any = None) -> tuple[jax.Array, jax.Array]:
        """x and l of M x = force + G^T l and f(x) = 0, from x = 0, where f is `begun`."""
        x, l = answer.solved(force, list(-begun))
        for _ in range(many - 1):
            more = answer.solved(None, list(-f(x)))
            x, l = x + more[0], l + more[1]
        return x, l

    def linear(f: Residual, x: jax.Array) -> Solve:
        def left(dx: jax.Array, c: jax.Array) -> jax.Array:
            return jax.jvp(f, (x,), (dx,))[1] - c

        return lambda force, c: iterated(lambda dx: left(dx, c), -c, force)

    def level(dq: jax.Array) -> jax.Array:
        return leveled(now, rows, off(d, model, t, q, dq, v)[0], dq)

    def rate(dv: jax.Array) -> jax.Array:
        return off(d, model, t, q, dq, v + dv)[1]

    dq, l = jnp.zeros_like(v), jnp.zeros(len(rows), v.dtype)
    begun = off_of(rows, v)
    of_positions: Solve = _unmoved
    if positions and any(row.holonomic for row in rows):
        dq, l = iterated(level, begun[0])
        begun, of_positions = off(d, model, t, q, dq, v), linear(level, dq)
    dv, m = iterated(rate, begun[1])
    return Changes(dq, l, dv, m, of_positions, linear(rate, dv))


def _unmoved(force: jax.Array, c: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jnp.zeros_like(force), jnp.zeros_like(c)


#: of Newton's method, by bytes of a number: from the error of a stage, below 0.1, to rounding
TANGENT_ITERATIONS = {4: 3, 8: 5}


def across(
    model: Model, t: Any, state: State, t0: Any, start: State, iterations: int | None = None
) -> State:
    """The state on the constraints with the z and s of another, of the tangent space at `start`."""
    q, v, top = start.q, state.v, model.topology
    many = TANGENT_ITERATIONS[q.dtype.itemsize] if iterations is None else iterations
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
    size = size + diagonal_floor(size, usual, 1.0)
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
