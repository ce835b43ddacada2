"""Constraints of a point of one body on a curve or a surface that is fixed in another body.

    surface   f(x) = 0                                                   1 row
    curve     n_1 . (x - c(s)) = 0,  n_2 . (x - c(s)) = 0                2 rows

x is the origin of B in A's axes. s(x) is the parameter of the curve's point nearest to x, a root of

    F(x, s) = (x - c(s)) . c'(s) = 0,       ds = -F_x dx / F_s,      F_s = (x - c) . c'' - |c'|^2

n_1 and n_2 span the plane orthogonal to c'(s). s(x) is smooth if x is nearer to the curve than the
centre of curvature (F_s < 0), and nearer to one branch of the curve than to others. For a curve
that crosses itself, model s as a coordinate of its own (a slide).

Source: do Carmo, *Differential Geometry of Curves and Surfaces*, 1.5, 2.7.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp

from rbjax.constraints.rows.functions import arrays, check_functions, evaluate
from rbjax.constraints.rows.geometry import AXES, along
from rbjax.constraints.rows.row import Constraint, Row, function_of
from rbjax.dynamics.tracing.custom_rules import jvp_of, with_jvp
from rbjax.errors import InputError
from rbjax.forces.context import Context
from rbjax.forces.place import Place, as_place, check_places
from rbjax.model.record import check_fields, floats

#: iterations of Newton's method from the nearest of the points `starts`
NEWTON_STEPS = 8


def _position(a: Place, b: Place, context: Context) -> list[Row]:
    """Build the three rows of the origin of b in a's axes."""
    A, B = a.frame(context), b.frame(context)
    return [along(A, u, B) for u in AXES]


def _inner(a: jax.Array, b: jax.Array) -> jax.Array:
    return (a * b).sum(-1)


class PointOnSurface(Constraint):
    """The origin of b on the surface f(x) = 0, with x in a's axes: one row.

    Fields:
        a, b: `Place`s on the two bodies.
        f: static, x (3,) m, or (x, numbers) -> (). Its gradient must not vanish on the surface.
        numbers: pytree of parameters of f, or None.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.constraints import Place, PointOnSurface
        >>> def ellipsoid(x, axes):
        ...     return jnp.sum((x / axes) ** 2) - 1.0
        >>> PointOnSurface(Place.on(), Place.on(body="box"), ellipsoid, jnp.ones(3)).size
        1
    """

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    f: Callable = eqx.field(static=True)
    numbers: Any = eqx.field(converter=arrays, default=None)
    size = 1

    def __check_init__(self) -> None:
        check_places(self)
        check_functions(self, "f")

    def rows(self, context: Context) -> Sequence[Row]:
        def height(x: jax.Array) -> jax.Array:
            return evaluate("PointOnSurface: f", self.f, self.numbers, (x,), (), x.dtype)[None]

        return function_of(_position(self.a, self.b, context), height, context.q.dtype)


class PointOnCurve(Constraint):
    """The origin of b on the curve c(s), in a's axes: two rows.

    Fields:
        a, b: `Place`s on the two bodies.
        c: static, s (), or (s, numbers) -> (3,) m. c' must not vanish. A closed curve is periodic.
        starts: (n,) parameters s. Newton's method starts from the nearest one, so they must be
            dense enough for it to converge to the nearest point of the curve.
        numbers: pytree of parameters of c, or None.

    Example:
        >>> import rbjax as rb, jax.numpy as jnp
        >>> from rbjax.constraints import Place, PointOnCurve
        >>> def helix(s):
        ...     return jnp.stack([jnp.cos(s), jnp.sin(s), 0.1 * s])
        >>> table = jnp.linspace(0.0, 9.0, 40)
        >>> bead = PointOnCurve(Place.on(), Place.on(body="box"), helix, table)
        >>> round(float(bead.nearest(jnp.array([0.0, 1.1, 0.1571]))), 3)
        1.571
    """

    a: Place = eqx.field(converter=as_place)
    b: Place = eqx.field(converter=as_place)
    c: Callable = eqx.field(static=True)
    starts: jax.Array = eqx.field(converter=floats)
    numbers: Any = eqx.field(converter=arrays, default=None)
    size = 2

    def __check_init__(self) -> None:
        check_places(self)
        check_functions(self, "c")
        check_fields(self)
        if len(jnp.shape(self.starts)) != 1 or not jnp.shape(self.starts)[0]:
            raise InputError(
                f"PointOnCurve(starts=...): got the shape {jnp.shape(self.starts)}, expected (n,), "
                "parameters along the curve, as jnp.linspace makes them"
            )

    def point(self, s: jax.Array) -> jax.Array:
        """Return the point c(s) (3,), m in a's axes."""
        return _curve(self.c, self.numbers, s)

    def nearest(self, x: jax.Array) -> jax.Array:
        """Return the parameter () of the curve's point nearest to x (3,). It is differentiable."""
        return _nearest(self.c)(x, self.numbers, self.starts.astype(x.dtype))

    def rows(self, context: Context) -> Sequence[Row]:
        def components(x: jax.Array) -> jax.Array:
            c, dc = _with_slope(self.point, self.nearest(x))
            return jnp.stack([_inner(n, x - c) for n in _normals(dc)])

        return function_of(_position(self.a, self.b, context), components, context.q.dtype)


def _curve(c: Callable, numbers: Any, s: jax.Array) -> jax.Array:
    return evaluate("PointOnCurve: c", c, numbers, (s,), (3,), s.dtype)


def _with_slope(f: Callable, s: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return f(s) and f'(s) of a function of one scalar."""
    return jax.jvp(f, (s,), (jnp.ones_like(s),))


def _normals(along: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return two orthogonal unit vectors that are orthogonal to a direction (3,). They jump if the
    coordinate axis most orthogonal to the direction changes. Multipliers then jump too, but forces
    do not."""
    t = along / jnp.sqrt(_inner(along, along))
    least = jnp.eye(3, dtype=t.dtype)[jnp.argmin(jnp.abs(jax.lax.stop_gradient(t)))]
    n = jnp.cross(t, least)
    n = n / jnp.sqrt(_inner(n, n))
    return n, jnp.cross(t, n)


def _nearest(c: Callable) -> Callable:
    """Return the function (x, numbers, starts) -> s of the point c(s) of the curve nearest to x.

    Its derivative is that of the implicit function F(x, s) = 0. numbers: parameters of c. starts:
    values of s from which Newton's method may start.
    """

    def F(x: jax.Array, numbers: Any, s: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return F(x, s) and |c'(s)|^2. F is zero at the parameter s of the curve's point nearest
        to x."""
        point, slope = _with_slope(lambda s: _curve(c, numbers, s), s)
        return _inner(x - point, slope), _inner(slope, slope)

    def find(x: jax.Array, numbers: Any, starts: jax.Array) -> jax.Array:
        d = x - jax.vmap(lambda s: _curve(c, numbers, s))(starts)

        def newton(_: Any, s: jax.Array) -> jax.Array:
            value, slope, size = jax.jvp(
                lambda s: F(x, numbers, s), (s,), (jnp.ones_like(s),), has_aux=True
            )
            # beyond the centre of curvature Newton's step leads to a maximum: use Gauss-Newton
            return s - value / jnp.where(slope < -0.1 * size, slope, -size)

        return jax.lax.fori_loop(0, NEWTON_STEPS, newton, starts[jnp.argmin(_inner(d, d))])

    def rule(primals: tuple, tangents: tuple) -> tuple:
        s = nearest(*primals)
        x, numbers, _ = primals
        _, change = jvp_of(lambda x, numbers: F(x, numbers, s)[0], (x, numbers), tangents[:2])
        _, slope = _with_slope(lambda s: F(x, numbers, s)[0], s)
        return s, jnp.zeros_like(s) if change is None else -change / slope

    nearest = with_jvp(find, rule)
    return nearest
