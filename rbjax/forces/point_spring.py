"""A spring and a damper between two points.

With l the distance of the points, u the direction from one to the other, and l' = u . (v_b - v_a):

    x = l - l_high  where l > l_high,    l - l_low  where l < l_low,    else 0
    F = x (k_0 + k_1 x + k_2 x^2 + ...) + l' (d_0 + d_1 |l'| + d_2 |l'|^2 + ...)

pulls a along u and b against it. Between l_low and l_high (a deadband; equal for a plain spring)
the spring is slack; with l_low = 0 it is a rope's. The damper always works. The spring stores

    V = x^2 (k_0 / 2 + k_1 x / 3 + k_2 x^2 / 4 + ...).

The direction of two points that meet is not defined, and F must then be 0 for a smooth motion. It
is 0 for l_high = 0: there F u = (k_0 + k_1 l + ...) (p_b - p_a) has no singularity, and is computed
in this form. Elsewhere a stretched spring at l = 0 gives no force rather than one of any direction;
its derivatives stay finite.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.forces.context import Context
from rbjax.forces.element import Element, Loads, Shapes
from rbjax.forces.joints.polynomials import polynomial
from rbjax.forces.place import Place, check_places
from rbjax.lanes import Lane, Vec3, add, is_literal, is_zero, mul, sub
from rbjax.model import Model
from rbjax.model.leaves import table
from rbjax.model.links import lane
from rbjax.rotations.coefficients import where


class PointSpring(Element):
    """A spring and a damper between two points of bodies or of the world.

    F = x (k_0 + k_1 x + ...) + l' (d_0 + d_1 |l'| + ...), x beyond the slack [l_low, l_high].

    Fields: a, b, its ends, `Place`s; stiffness k (s,) N/m, N/m^2, ...; damping d (c,) N s/m,
    N s^2/m^2, ...; slack (2,) m, the lengths between which the spring is slack. `PointSpring.of`
    makes it from single numbers.

    Source: MuJoCo, XML reference, tendon spatial (stiffness, damping, springlength).

    Example:
        >>> import rbjax as rb
        >>> model = rb.load("quadrotor")
        >>> tether = rb.forces.PointSpring.of(
        ...     rb.forces.Place.on(point=[0.0, 0.0, 10.0]), rb.forces.Place.on(body=0),
        ...     stiffness=3.0, length=9.0,
        ... )
        >>> model, state = model.with_forces(tether), model.default_state()
        >>> height = float(state.q[2])
        >>> bool(abs(rb.applied_forces(model, state)[2] - 3 * (10 - height - 9)) < 1e-5)
        True
    """

    a: Place
    b: Place
    stiffness: jax.Array
    damping: jax.Array
    slack: jax.Array

    @classmethod
    def of(
        cls, a: Place, b: Place, *, stiffness: Any = 0.0, damping: Any = 0.0, length: Any = 0.0
    ) -> PointSpring:
        """The spring of this length at rest, or slack between two lengths."""
        where, given = "PointSpring.of", {"stiffness": stiffness, "damping": damping}
        row = {n: (max(1, *shape_of(where, n, x), 1),) for n, x in given.items()}
        k, d = (check_array(where, n, x, (), row[n]) for n, x in given.items())
        slack = check_array(where, "length", length, (), (2,))
        k, d, slack = (x.astype(float) for x in (k, d, slack))
        return cls(a, b, jnp.atleast_1d(k), jnp.atleast_1d(d), jnp.broadcast_to(slack, (2,)))

    def __check_init__(self) -> None:
        check_places(self)

    def may_be_endless(self, name: str) -> bool:
        return name == "slack"

    def shapes(self, model: Model) -> Shapes:
        return {"stiffness": (None,), "damping": (None,), "slack": (2,)}

    def loads(self, now: Context) -> Loads:
        a, b = self.a.point(now), self.b.point(now)
        k, d = self._numbers(self.stiffness, now), self._numbers(self.damping, now)
        springy, damped = (not all(map(is_zero, c)) for c in (k, d))
        if not (springy or damped):
            return Loads()
        line = b.position - a.position
        length, inverse = _distance(line, now.q.dtype)
        scale: Lane = 0.0  # F / l
        if springy:
            x, x_over_l = self._stretch(length, inverse, now)
            scale = mul(add(k[0], polynomial(k[1:], x)), x_over_l)
        if damped:
            rate = mul((b.velocity - a.velocity).dot(line), inverse)
            speed = jnp.abs(rate) if len(d) > 1 else 0.0
            scale = add(scale, mul(mul(add(d[0], polynomial(d[1:], speed)), rate), inverse))
        force = line * scale
        return a.push(force) + b.push(-force)

    def energy(self, now: Context) -> Lane:
        """x^2 (k_0 / 2 + k_1 x / 3 + ...)."""
        k = self._numbers(self.stiffness, now)
        if all(map(is_zero, k)):
            return 0.0
        line = self.b.point(now).position - self.a.point(now).position
        length, inverse = _distance(line, now.q.dtype)
        x, _ = self._stretch(length, inverse, now)
        shares = [mul(1 / n, c) for n, c in enumerate(k, 2)]
        return mul(add(shares[0], polynomial(shares[1:], x)), x * x)

    def _numbers(self, numbers: jax.Array, now: Context) -> list[Lane]:
        known = table(numbers, now.q.dtype)
        found = [lane(known, i) for i in range(known.shape[0])]
        while len(found) > 1 and is_zero(found[-1]):
            found.pop()
        return found

    def _stretch(self, length: Lane, inverse: Lane, now: Context) -> tuple[Lane, Lane]:
        """x, and x / l, where each is smooth."""
        slack = table(self.slack, now.q.dtype)
        low, high = lane(slack, 0), lane(slack, 1)
        x, ratio = sub(length, high), sub(1.0, mul(high, inverse))
        if is_literal(low) and is_literal(high) and low == high:
            return x, ratio
        shorter, short_ratio = sub(length, low), sub(1.0, mul(low, inverse))
        nothing = jnp.zeros_like(length)
        x = where(length > high, x, where(length < low, shorter, nothing))
        return x, where(length > high, ratio, where(length < low, short_ratio, nothing))


def _distance(line: Vec3, dtype: Any) -> tuple[Lane, Lane]:
    """The length of a vector and its inverse, which counts as 1 where the length is 0."""
    square = jnp.asarray(line.dot(line), dtype)
    some = square > 0
    root = jnp.sqrt(where(some, square, jnp.ones_like(square)))
    return where(some, root, jnp.zeros_like(square)), 1 / root
