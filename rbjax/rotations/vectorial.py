"""The vectorial parametrizations of rotation: p = p(phi) n, one function p(phi) for each.

Bauchau & Trainelli (Nonlinear Dynamics 32, 2003); Masarati, appendix A, Table A.1. With p scaled
to p ~ phi at zero, s = |p|^2 and w = cos(phi/2),

    R      = 1 + (sin phi / p) [p] + a [p]^2           a = (1 - cos phi) / s
    omega_space = H p',   H = m 1 + a [p] + b [p]^2    m = 1 / p'(phi),  b = (m - sin phi / p) / s
    H^-1   = (1/m) 1 - [p]/2 + g [p]^2                 g = (1/m - (p/2) cot(phi/2)) / s

For body axes it is H^T. In the formulas of each parametrization the quotients by s are cancelled.

    euler_vector              phi              singular (kinematics) at phi = 2 pi
    linear                    sin phi          pi/2; covers less than a quarter turn
    reduced_euler_rodrigues   2 sin(phi/2)     pi
    cayley, gibbs             2 tan(phi/2), tan(phi/2)      pi
    wiener_milenkovic, mrp    4 tan(phi/4), tan(phi/4)      2 pi
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.lanes import safe_sqrt
from rbjax.rotations import quaternion
from rbjax.rotations.arguments import entries, spread, stacked, takes
from rbjax.rotations.coefficients import (
    arctan_over,
    away_from_zero,
    inverse_jacobian_coefficient,
    polynomial,
    stumpff,
    where,
)


@dataclass(frozen=True)
class Vectorial:
    """A vectorial parametrization, defined by p(phi)."""

    quaternion: Callable[[list, jax.Array], list]  # function of (p, s) that returns a quaternion
    parameter: Callable[[jax.Array, list], jax.Array]  # p / u, for a quaternion (w, u), w >= 0
    map: Callable[[jax.Array], tuple]  # function of s that returns (m, a, b)
    inverse_map: Callable[[jax.Array], tuple]  # function of s that returns (1/m, g)
    angle: Callable[[jax.Array], jax.Array]  # function of s that returns the rotation angle
    singular_angle: float
    singular_set: str
    scale: float = 1.0  # the parameters are scale * p
    short: bool = True  # True if `parameter` has few operations and is evaluated for each entry

    size = 3

    def to_quaternion(self, x: list) -> list:
        p, s = self._scaled(x)
        return self.quaternion(p, s)

    def from_quaternion(self, q: list) -> jax.Array:
        w, *u = (spread(a, 3) for a in q) if self.short else (a[..., None] for a in q)
        sign = where(w < 0, -jnp.ones_like(w), jnp.ones_like(w))
        return sign * self.scale * self.parameter(w * sign, u) * stacked(q[1:])

    def body_rate(self, x: list) -> list:
        p, s = self._scaled(x)
        m, a, b = (c / self.scale for c in self.map(s))
        return polynomial(m, -a, b, p)

    def space_rate(self, x: list) -> list:
        p, s = self._scaled(x)
        m, a, b = (c / self.scale for c in self.map(s))
        return polynomial(m, a, b, p)

    def inverse_body_rate(self, x: list) -> list:
        p, s = self._scaled(x)
        m, g = (c * self.scale for c in self.inverse_map(s))
        return polynomial(m, 0.5 * self.scale, g, p)

    def inverse_space_rate(self, x: list) -> list:
        p, s = self._scaled(x)
        m, g = (c * self.scale for c in self.inverse_map(s))
        return polynomial(m, -0.5 * self.scale, g, p)

    def distance(self, x: list) -> jax.Array:
        """Return the angle of the rotation about the same axis to the singularity."""
        return jnp.abs(self.singular_angle - self.angle(self._scaled(x)[1]))

    def _scaled(self, x: list) -> tuple[list, jax.Array]:
        p = [a / self.scale for a in x]
        return p, sum(a * a for a in p)


def _square(u: list) -> jax.Array:
    return sum(a * a for a in u)


def _norm(w: jax.Array, u: list) -> jax.Array:
    return jnp.sqrt(w * w + _square(u))


def _cosine(s: jax.Array) -> jax.Array:
    """Compute sqrt(1 - s), or a tiny positive number if s >= 1."""
    return away_from_zero(safe_sqrt(jnp.maximum(1 - s, 0.0)))


def _euler_vector() -> Vectorial:
    def stumpff_map(s):
        c2, c3 = stumpff(s, 2, 3)
        return 1.0, c2, c3

    return Vectorial(
        quaternion=lambda p, s: quaternion.exp_lanes(p),
        parameter=lambda w, u: 2 * arctan_over(w, _square(u)),
        map=stumpff_map,
        inverse_map=lambda s: (1.0, inverse_jacobian_coefficient(s)),
        angle=safe_sqrt,
        singular_angle=2 * jnp.pi,
        singular_set="the vector has length 2 pi: rates orthogonal to it rotate nothing",
        short=False,
    )


def _linear() -> Vectorial:
    def linear_map(s):
        c = _cosine(s)
        return 1 / c, 1 / (1 + c), 1 / (c * (1 + c))

    def linear_inverse(s):
        c = _cosine(s)
        return c, -0.5 / (1 + c)

    return Vectorial(
        quaternion=lambda p, s: [1 + _cosine(s), *p],
        parameter=lambda w, u: 2 * w / (w * w + _square(u)),
        map=linear_map,
        inverse_map=linear_inverse,
        angle=lambda s: safe_sqrt(s) * arctan_over(_cosine(s), s),
        singular_angle=jnp.pi / 2,
        singular_set="a quarter turn; larger turns have no parameter",
    )


def _reduced_euler_rodrigues() -> Vectorial:
    def reduced_map(s):
        w = _cosine(s / 4)
        return 1 / w, jnp.full_like(s, 0.5), 0.25 / w

    return Vectorial(
        quaternion=lambda p, s: [_cosine(s / 4), *(a / 2 for a in p)],
        parameter=lambda w, u: 2 / _norm(w, u),
        map=reduced_map,
        inverse_map=lambda s: (_cosine(s / 4), 0.0),
        angle=lambda s: safe_sqrt(s) * arctan_over(_cosine(s / 4), s / 4),
        singular_angle=jnp.pi,
        singular_set="half a turn",
    )


def _cayley(scale: float) -> Vectorial:
    def cayley_map(s):
        m = 1 / (1 + s / 4)
        return m, m / 2, 0.0

    return Vectorial(
        quaternion=lambda p, s: [jnp.ones_like(s), *(a / 2 for a in p)],
        parameter=lambda w, u: 2 / away_from_zero(w),
        map=cayley_map,
        inverse_map=lambda s: (1 + s / 4, 0.25),
        angle=lambda s: safe_sqrt(s) * arctan_over(jnp.ones_like(s), s / 4),
        singular_angle=jnp.pi,
        singular_set="half a turn, where the parameter is infinite",
        scale=scale,
    )


def _wiener_milenkovic(scale: float) -> Vectorial:
    def milenkovic_map(s):
        m = 1 / (1 + s / 16)
        return m, m * m / 2, m * m / 8

    return Vectorial(
        quaternion=lambda p, s: [1 - s / 16, *(a / 2 for a in p)],
        parameter=lambda w, u: 4 / (w + _norm(w, u)),
        map=milenkovic_map,
        inverse_map=lambda s: (1 + s / 16, 0.125),
        angle=lambda s: safe_sqrt(s) * arctan_over(jnp.ones_like(s), s / 16),
        singular_angle=2 * jnp.pi,
        singular_set="a full turn, where the parameter is infinite; its shadow is near zero there",
        scale=scale,
    )


VECTORIAL: dict[str, Vectorial] = {
    "euler_vector": _euler_vector(),
    "linear": _linear(),
    "reduced_euler_rodrigues": _reduced_euler_rodrigues(),
    "cayley": _cayley(1.0),
    "gibbs": _cayley(0.5),
    "wiener_milenkovic": _wiener_milenkovic(1.0),
    "mrp": _wiener_milenkovic(0.25),
}


@takes(p="vector")
def mrp_shadow(p: ArrayLike) -> jax.Array:
    """Compute the shadow -p / |p|^2 (..., 3), the other MRP of the same attitude.

    The shadow of p = 0 is infinite. The result is then finite, without nan.

    Args:
        p: (..., 3), modified Rodrigues parameters, no unit.

    Returns:
        (..., 3), MRP of the same attitude, no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations import mrp_shadow
        >>> mrp_shadow([0.0, 0.0, 2.0]).tolist()
        [-0.0, -0.0, -0.5]
    """
    x = entries(p)
    scale = -1 / away_from_zero(_square(x))
    return stacked([scale * a for a in x])


@takes(p="vector")
def mrp_short(p: ArrayLike) -> jax.Array:
    """Return p or its shadow, whichever is shorter, with length at most 1 and angle at most pi.

    Args:
        p: (..., 3), modified Rodrigues parameters, no unit.

    Returns:
        (..., 3), MRP of the same attitude, no unit.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.rotations import mrp_short
        >>> mrp_short([0.0, 0.0, 2.0]).tolist(), mrp_short([0.0, 0.0, 0.5]).tolist()
        ([-0.0, -0.0, -0.5], [0.0, 0.0, 0.5])
    """
    long = (p * p).sum(-1, keepdims=True) > 1
    return jnp.where(long, mrp_shadow(jnp.where(long, p, 1.0)), p)
