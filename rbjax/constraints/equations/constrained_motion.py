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

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.constraints.equations.model_rows import (
    by_link,
    gradient_matrix,
    rows_of,
    with_multipliers,
)
from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import Factor, aba, accelerated, eliminated, solve
from rbjax.dynamics.algorithms.rnea import LinkForces, rnea
from rbjax.dynamics.drivers.choice import Driver, driver
from rbjax.dynamics.tracing.custom_rules import jax_arrays, split_tracers, with_implicit_jvp
from rbjax.forces.context import Context
from rbjax.forces.element import Loads
from rbjax.lanes import (
    Lane,
    Vec3,
    add,
    batch_first,
    fusion_barrier,
    is_literal,
    is_zero,
    mul,
    neg,
    sub,
    total,
)
from rbjax.lanes.arrays import matmat, matvec, pack
from rbjax.lanes.factorization import LeastNorm, diagonal_floor, regularization
from rbjax.model import WORLD, Model, State
from rbjax.spatial import Force

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

    def plain(*at):
        return batch_first((run(*at)[0],), at)

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

    at = jax_arrays(given, state.q, state.v, tau)
    (found,) = with_implicit_jvp(plain, solved, residual)(*at)
    return found[:nv], found[nv:]


def asked(row: Row, alpha: Any, beta: Any) -> Lane:
    """What a row asks of G times the change of a: -g'' - 2 alpha g' - beta^2 g."""
    out = add(row.acceleration, mul(mul(2.0, alpha), row.rate))
    return neg(add(out, mul(mul(beta, beta), row.residual)))


#: up to so many rows A is factored on lanes, where blocks that do not meet cost nothing
ROWS_ON_LANES = 24


def as_free_bodies(d: Driver, row: Row) -> Lane:
    """What a row's entry of A would be if the links that it acts on were free bodies, of the same
    inertia in all directions: the sum of f^2 / m of forces f, or of n^2 / (tr J / 3) of couples n
    where there are no forces. It does not vanish with the arms of a force."""
    out: Lane = 0.0
    for link, load in by_link(row.gradient).items():
        body = d.prepared.link(link).inertia
        if any(not is_zero(x) for x in load.lin):
            out = add(out, _over(load.lin, body.m))
        else:
            xx, yy, zz, *_ = body.J
            out = add(out, _over(load.ang, mul(1 / 3, add(add(xx, yy), zz))))
    return out


def _over(load: Vec3, inertia: Lane) -> Lane:
    """load^2 / inertia; zero for a link without any."""
    if is_literal(inertia):
        return mul(1.0 / inertia if inertia > 0 else 0.0, load.dot(load))
    some = inertia > 0
    return mul(load.dot(load), jnp.where(some, 1.0 / jnp.where(some, inertia, 1.0), 0.0))


def response(
    d: Driver, factors: Any, now: Context, rows: Sequence[Row], damping: float | None = None
) -> Response:
    """By lanes where the driver walks the tree link by link; by matrices otherwise. damping: eps
    and e, taken back once, for one of several iterations; None: those of the dtype."""
    few = d.listed and len(rows) <= ROWS_ON_LANES
    return (OnLanes if few else OnMatrices)(d, factors, now, rows, damping)


def eliminated_along(
    parents: Sequence[int],
    factors: Mapping[int, Factor],
    links: Sequence[int],
    loads: Loads,
    base: int = WORLD,
) -> tuple[dict[int, Lane], dict[int, Lane], Force]:
    """The force u that loads leave at each joint that they reach, of links from the tips inward;
    e = u / D; and the wrench that they leave at the base that the links hang on."""
    pending, us, es = dict(by_link(loads)), {}, {}
    for i in links:
        tau = loads.tau.get(i, 0.0)
        if i not in pending and is_zero(tau):
            continue
        f, x, parent = pending.pop(i, Force.zero()), factors[i], parents[i]
        u = add(tau, x.S.dot(f))
        e, message = mul(u, x.inverse_D), None
        if parent != WORLD:
            message = pending.get(parent, Force.zero()) + x.X.T(f - x.U * e)
        us[i], es[i], message = fusion_barrier((u, e, message), known=(tau, f, x))
        if parent != WORLD:
            pending[parent] = message
    return us, es, pending.get(base, Force.zero())


def shared(a: dict[int, Lane], b: dict[int, Lane]) -> Lane:
    """The sum of products over the joints that both have."""
    return fusion_barrier(total(mul(a[i], b[i]) for i in sorted(a.keys() & b.keys())))


def triangle(u: Sequence[dict[int, Lane]], e: Sequence[dict[int, Lane]]) -> list[list[Lane]]:
    """A by its lower triangle, from what its rows leave at the joints."""
    return [[shared(a, b) for b in e[: r + 1]] for r, a in enumerate(u)]


class Response:
    """What multipliers do, from the factors of the mass matrix."""

    def __init__(
        self, d: Driver, factors: Any, now: Context, rows: Sequence[Row], damping: float | None
    ):
        self._d, self._factors, self._like, self._damping = d, factors, now.v, damping
        self._free = [as_free_bodies(d, row) for row in rows]

    def solved(self, force: jax.Array | None, c: Sequence[Lane]) -> tuple[jax.Array, jax.Array]:
        """a (nv,) and l (rows,), of least norm, of M a = force + G^T l, G a = c; force None is
        zero."""
        raise NotImplementedError(f"{type(self).__name__} has no method solved(force, c) -> a, l")


class OnLanes(Response):
    """A from the forces that are left at the joints which two rows share."""

    def __init__(
        self, d: Driver, factors: Any, now: Context, rows: Sequence[Row], damping: float | None
    ):
        super().__init__(d, factors, now, rows, damping)
        links = dict(enumerate(d.whole(factors)))
        inward = sorted(links, reverse=True)
        parents = d.topology.parents
        units = [eliminated_along(parents, links, inward, row.gradient) for row in rows]
        self._u, self._e = [u for u, _, _ in units], [e for _, e, _ in units]

    @cached_property
    def _A(self) -> LeastNorm:
        A = triangle(self._u, self._e)
        return LeastNorm(A, self._free, self._like.dtype, self._damping)

    def solved(self, force: jax.Array | None, c: Sequence[Lane]) -> tuple[jax.Array, jax.Array]:
        d, left = self._d, {}
        if force is not None:
            left = dict(enumerate(d.whole(d.part(eliminated(d, self._factors, d.lanes(force)), 1))))
            c = [sub(x, shared(left, e)) for x, e in zip(c, self._e, strict=True)]
        l = self._A.solve(c)
        for own, x in zip(self._u, l, strict=True):
            for i, y in own.items():
                left[i] = add(left.get(i, 0.0), mul(x, y))
        a = accelerated(d, d.zip(self._factors, d.scattered(left, 0.0)))
        return d.pack(a, self._like), pack(l, self._like)


class OnMatrices(Response):
    """A = G Y, Y = M^-1 G^T; R (rows,), if any, is added to its diagonal: compliance of the rows,
    G a + R l = c."""

    def __init__(
        self,
        d: Driver,
        factors: Any,
        now: Context,
        rows: Sequence[Row],
        damping: float | None = None,
        R: jax.Array | None = None,
    ):
        super().__init__(d, factors, now, rows, damping)
        self._R, self.usual = R, pack(self._free, now.v)
        self.G = gradient_matrix(now, rows)
        self.Y = jax.vmap(lambda row: d.pack(solve(d, factors, d.lanes(row)), row))(self.G).T

    @cached_property
    def A(self) -> jax.Array:
        A = matmat(self.G, self.Y)
        return A if self._R is None else A + jnp.diag(self._R)

    def solved(self, force: jax.Array | None, c: Sequence[Lane]) -> tuple[jax.Array, jax.Array]:
        d, asked = self._d, pack(c, self._like)
        if force is None:
            l = least_norm(self.A, asked, self.usual, self._damping)
            return matvec(self.Y, l), l
        free = d.pack(solve(d, self._factors, d.lanes(force)), force)
        l = least_norm(self.A, asked - matvec(self.G, free), self.usual, self._damping)
        return free + matvec(self.Y, l), l


def least_norm(
    A: jax.Array, c: jax.Array, B: jax.Array | float = 0.0, damping: float | None = None
) -> jax.Array:
    """l of A l = c, of least norm; B (rows,) of free bodies, zero where it is not known; damping as
    `response`."""
    eps, vanishing, again = regularization(A.dtype, damping)
    diagonal = jnp.diagonal(A)
    D = diagonal + diagonal_floor(diagonal, B, vanishing) / eps
    s = jnp.where(D > 0, 1.0, 0.0) / jnp.sqrt(jnp.where(D > 0, D, 1.0))
    scaled = s[:, None] * A * s[None]
    factors = jax.scipy.linalg.cho_factor(scaled + eps * jnp.eye(len(A), dtype=A.dtype))
    b = s * c
    l = jax.scipy.linalg.cho_solve(factors, b)
    for _ in range(again):
        l = l + jax.scipy.linalg.cho_solve(factors, b - matvec(scaled, l))
    return s * l
