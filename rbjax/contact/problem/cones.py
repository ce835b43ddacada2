"""Forces of one contact as functions of its residual, and their negative derivatives.

The residual r = J x - a_ref is in the axes of the contact: the normal, the tangents, then the axes
of spin and rolling. The force f = -ds/dr minimises the cost s, and H = d2s/dr2:

    frictionless   s = D r0^2 / 2 for r0 < 0
    pyramid        the sum of that over the edges r0 +- mu_k r_k
    elliptic       N = mu r0, U_k = mu_k r_k, T = |U|:
                   0 for N >= mu T;   sum D_k r_k^2 / 2 for mu N + T <= 0;
                   else D0 (N - mu T)^2 / (2 mu^2 (1 + mu^2)),   D_k = D0 impratio mu_k^2 / mu_1^2

with mu = mu_1 / sqrt(impratio) (Todorov, *Convex and analytically-invertible dynamics with contacts
and constraints*, 2014; MuJoCo, *Computation*, "Constraint model").
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp

from rbjax.lanes import Lane, add, is_literal, mul, neg, sub, total

#: a squared tangential residual below which the cone has no tangential direction
TINY = 1e-30


class Response(NamedTuple):
    """The force f of a contact, and its Hessian H as rows of the lower triangle."""

    f: list[Lane]
    H: list[list[Lane]]


class Cone(NamedTuple):
    """The friction cone of a contact.

    Fields:
        elliptic: whether the cone is elliptic or a pyramid.
        D: the inverse regularization of the normal row, or of each edge of a pyramid.
        mu: friction coefficients of the other rows; empty if the contact is frictionless.
        impratio: impedance of friction over the impedance of the normal row.
    """

    elliptic: bool
    D: Lane
    mu: tuple[Lane, ...]
    impratio: Lane = 1.0

    def response(self, r: Sequence[Lane]) -> Response:
        """Compute the force and the Hessian of the cost at the residual r = J x - a_ref of each
        row."""
        if not self.mu:
            return _frictionless(r[0], self.D)
        if self.elliptic:
            return _elliptic(r, self.D, self.mu, self.impratio)
        return _pyramid(r, self.D, self.mu)


def _frictionless(r: Lane, D: Lane) -> Response:
    active = jnp.where(r < 0, D, 0.0)
    return Response([neg(mul(active, r))], [[active]])


def _pyramid(r: Sequence[Lane], D: Lane, mu: Sequence[Lane]) -> Response:
    n = len(mu)
    f: list[Lane] = [0.0] * (n + 1)
    H: list[list[Lane]] = [[0.0] * (i + 1) for i in range(n + 1)]
    for k, m in enumerate(mu, 1):
        for sign in (1.0, -1.0):
            arm = mul(sign, m)
            edge = add(r[0], mul(arm, r[k]))
            active = jnp.where(edge < 0, D, 0.0)
            push = mul(active, edge)
            f[0], f[k] = sub(f[0], push), sub(f[k], mul(arm, push))
            H[0][0] = add(H[0][0], active)
            H[k][0] = add(H[k][0], mul(arm, active))
            H[k][k] = add(H[k][k], mul(mul(m, m), active))
    return Response(f, H)


def _elliptic(r: Sequence[Lane], D: Lane, friction: Sequence[Lane], impratio: Lane) -> Response:
    root = impratio**0.5 if is_literal(impratio) else jnp.sqrt(impratio)
    mu = friction[0] / root
    N = mul(mu, r[0])
    U = [mul(m, x) for m, x in zip(friction, r[1:], strict=True)]
    square = total(mul(u, u) for u in U)
    slides = square > TINY
    T = jnp.where(slides, jnp.sqrt(jnp.where(slides, square, 1.0)), 0.0)
    inverse_T = jnp.where(slides, 1.0 / jnp.where(slides, T, 1.0), 0.0)
    free = mu * T <= N
    sticks = mu * N + T <= 0

    def zone(middle: Lane, sticking: Lane) -> Lane:
        return jnp.where(free, 0.0, jnp.where(sticks, sticking, middle))

    Dm = D / (mu * mu * (1.0 + mu * mu))
    gap = N - mu * T
    t = [mul(u, inverse_T) for u in U]
    ratio = [m / friction[0] for m in friction]
    D_t = [mul(mul(D, impratio), mul(x, x)) for x in ratio]
    pull = Dm * gap * mu
    f = [zone(-pull, -D * r[0])]
    f += [
        zone(pull * u * m, -d * x)
        for u, m, d, x in zip(t, friction, D_t, r[1:], strict=True)
    ]  # fmt: skip
    along, across = Dm * mu * mu, pull * inverse_T
    H = [[zone(along, D)]]
    for i, (u, m) in enumerate(zip(t, friction, strict=True)):
        row = [zone(-along * u * m, 0.0)]
        for j in range(i + 1):
            entry = (along + across) * u * t[j] - (across if i == j else 0.0)
            row.append(zone(entry * m * friction[j], D_t[i] if i == j else 0.0))
        H.append(row)
    return Response(f, H)
