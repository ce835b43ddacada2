"""The rows of a model at an instant, and how multipliers act on it.

    A = G M^-1 G^T,     a = M^-1 (tau - b + G^T l),     G a = c
(A is the Delassus matrix: what a unit multiplier does to the rows' accelerations.) With ABA's
factors an inward sweep along the ancestors of a row's links leaves a force u_i at each joint, and
A_rs = sum of u_r,i u_s,i / D_i over the joints that both rows reach:
no column of M^-1 is made. (Featherstone, *Rigid Body Dynamics Algorithms*, 8; Featherstone &
Orin 2000; Carpentier, Budhiraja & Mansard, *Proximal and sparse resolution of constrained
dynamics*, 2021.)

Redundant rows. A is singular where rows say the same twice. It is factored with eps diag(A) + e B
added, B the entries that diag(A) would have if links were free bodies, and what this falsifies is
taken back by iteration (proximal): l converges to the solution of least norm, in the norm of what
is added, with no decision about rank. Rows that push no link have tr(A) u in the place of e B, u
the rounding unit. Either keeps out rows that are zero but for rounding, as those of a plane loop
across its plane are: their own entry of A is rounding too.

Singular positions. A row may vanish, as that along the bars of a parallelogram that is flat: A has
its sigma^2 there. With y off the branch that it moves on, at a speed v, a motion that obeys the row
is a hyperbola, sigma y constant: rounding u of a row makes y = u / sigma, a velocity of v y / sigma
across the branch, and v^2 y / sigma^2 = v^2 u / sigma^3 of acceleration. e B damps these below
sigma = e^(1/2); diag(A) does not, for it vanishes with the row. Without B ten seconds of a
parallelogram in f32 (RK4, 1 ms, 20 J, 15 starts) gained 3e2 J or more, or were no numbers; with it
energy is kept to 6e-3 J. In f64 `projection` has damped y already, and e is small: across a branch
the acceleration is free where e damps. Ten seconds of 40 linkages (RK4, 1 ms, 620 J) lose 1.05e-5 J
with e = 1e-9, 7e-6 with 1e-10; two linkages by adaptive steps at 1e-11 have errors of 4e-10 and
1e-8, and of 2e-6 with e = 1e-11.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.constraints.rows.row import Row
from rbjax.dynamics.algorithms.aba import Factor, accelerated, eliminated, solve
from rbjax.dynamics.algorithms.link_forces import LinkForces, added
from rbjax.dynamics.drivers.choice import Driver
from rbjax.dynamics.drivers.packing import pack
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.element import Loads
from rbjax.lanes import Lane, Vec3, add, fusion_barrier, is_literal, is_zero, mul, sub, total
from rbjax.lanes.arrays import matmat, matvec
from rbjax.lanes.factorization import LeastNorm, damped, least
from rbjax.model import WORLD, Model
from rbjax.spatial import Force

#: up to so many rows A is factored on lanes, where blocks that do not meet cost nothing
ROWS_ON_LANES = 24


def rows_of(model: Model, now: Context) -> list[Row]:
    """All rows of the model's constraints, one constraint after the other."""
    out: list[Row] = []
    for constraint in model.constraints:
        rows = list(constraint.rows(now))
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
        out += [_computed(row, now) for row in rows]
    return out


def _computed(row: Row, now: Context) -> Row:
    """The row, its lanes computed once."""
    known = (now.q, now.v, now.a, now.t)
    parts = row.value, row.rate, row.acceleration, row.gradient.tau, row.gradient.wrenches
    value, rate, acceleration, tau, wrenches = fusion_barrier(parts, known=known)
    return Row(value, rate, Loads(tau, wrenches, row.gradient.internal), acceleration)


def by_link(loads: Loads) -> Mapping[int, Force]:
    """The wrenches of a row's gradient."""
    if isinstance(loads.wrenches, Force):
        raise InputError("a row's gradient has wrenches on all links, expected those on a few")
    return loads.wrenches


def arms(now: Context, row: Row) -> dict[int, Lane]:
    """The gradient of a row by velocity coordinate."""
    out = dict(row.gradient.tau)
    for link, force in by_link(row.gradient).items():
        for i, x in now.link(link).arms(force).items():
            out[i] = add(out.get(i, 0.0), x)
    return out


def gradient_matrix(now: Context, rows: Sequence[Row]) -> jax.Array:
    """G (m, nv)."""
    out = jnp.zeros((len(rows), now.model.nv), now.q.dtype)
    for r, row in enumerate(rows):
        found = {i: x for i, x in arms(now, row).items() if not is_zero(x)}
        if found:
            out = out.at[r, np.array(list(found))].set(pack(list(found.values()), now.v))
    return out


def with_multipliers(
    d: Driver, rows: Sequence[Row], l: Sequence[Lane], tau: jax.Array, f_ext: LinkForces
) -> tuple[jax.Array, LinkForces]:
    """tau + G^T l, in two parts: generalized forces (nv,) and forces on links."""
    held = sum((row.gradient * x for row, x in zip(rows, l, strict=True)), Loads())
    return tau + d.pack(d.scattered(held.tau, 0.0), tau), added(f_ext, held.wrenches)


def as_free_bodies(d: Driver, row: Row) -> Lane:
    """What a row's entry of A would be if the links that it pushes were free bodies, of the same
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
    eps, vanishing, again = damped(A.dtype, damping)
    diagonal = jnp.diagonal(A)
    D = diagonal + least(diagonal, B, vanishing) / eps
    s = jnp.where(D > 0, 1.0, 0.0) / jnp.sqrt(jnp.where(D > 0, D, 1.0))
    scaled = s[:, None] * A * s[None]
    factors = jax.scipy.linalg.cho_factor(scaled + eps * jnp.eye(len(A), dtype=A.dtype))
    b = s * c
    l = jax.scipy.linalg.cho_solve(factors, b)
    for _ in range(again):
        l = l + jax.scipy.linalg.cho_solve(factors, b - matvec(scaled, l))
    return s * l
