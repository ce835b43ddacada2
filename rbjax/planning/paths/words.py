"""The formulas of Dubins and of Reeds and Shepp: arcs and straight segments to a given pose.

A word is a sequence of arcs to the left (L) and to the right (R) and of straight segments (S). The
radius is 1, the start is at the origin with heading zero, and the goal is (x, y, phi). A length is
signed; negative means backwards. A left arc of length t turns the heading by t, a right one by -t.

The endpoint is an analytic function of the lengths, and 2 pi-periodic in the lengths of arcs. So
each formula below solves its equation for any sign of its lengths, and full turns may be
subtracted. A Dubins car drives arcs in [0, 2 pi), a Reeds-Shepp car in [-pi, pi]. A candidate is
rejected only if a root or an arc cosine does not exist. Its length is the sum of absolute values.
All candidates are admissible paths, and the shortest path is one of them.

A formula gives four words by two symmetries of the car's equations, and four more in reverse order
if its sequence of kinds is not a palindrome:

    driven backwards   (-x,  y, -phi)    all lengths change sign
    mirrored           ( x, -y, -phi)    L and R are exchanged
    in reverse order   (x cos phi + y sin phi, x sin phi - y cos phi, phi)

Source: Dubins, Amer. J. Math. 79 (1957) 497; Reeds & Shepp, Pacific J. Math. 145 (1990) 367,
section 8; the comments give the numbers of their equations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import safe_sqrt

QUARTER = math.pi / 2
#: tolerance beyond the range of a root or an arc cosine, in units of the last place
SLACK = 64.0


class Word(NamedTuple):
    """A sequence of segment kinds, and the formula of its lengths."""

    kinds: str  # letters L, S and R
    formula: Callable  # (x, y, phi) -> the signed lengths, and whether they exist
    reversible: bool = False  # whether the reverse order is another word


def _polar(x, y):
    """Compute the polar coordinates (r, theta) of a point, with zero derivatives at the origin."""
    r = safe_sqrt(x * x + y * y)
    return r, jnp.arctan2(y, jnp.where(r == 0, 1.0, x))


def _root(square):
    """Compute a square root, and whether it exists. At zero its derivative is zero."""
    return safe_sqrt(square), square >= -SLACK * jnp.finfo(square.dtype).eps


def _arccos(c):
    """Compute an arc cosine, and whether it exists. At +-1 its derivative is zero."""
    inside = jnp.abs(c) < 1
    end = jnp.where(c < 0, math.pi, 0.0)
    angle = jnp.where(inside, jnp.arccos(jnp.where(inside, c, 0.0)), end)
    return angle, jnp.abs(c) <= 1 + SLACK * jnp.finfo(c.dtype).eps


def _same_side(x, y, phi):
    """Compute the centre of the goal's left circle, relative to the start's left circle."""
    return x - jnp.sin(phi), y - 1 + jnp.cos(phi)


def _other_side(x, y, phi):
    """Compute the centre of the goal's right circle, relative to the start's left circle."""
    return x + jnp.sin(phi), y - 1 - jnp.cos(phi)


def _lsl(x, y, phi):  # 8.1
    u, t = _polar(*_same_side(x, y, phi))
    return (t, u, phi - t), jnp.ones(u.shape, bool)


def _lsr(x, y, phi):  # 8.2
    r, theta = _polar(*_other_side(x, y, phi))
    u, ok = _root(r * r - 4)
    t = theta + jnp.arctan2(2.0, u)
    return (t, u, t - phi), ok


def _lrl(x, y, phi):  # 8.3 and 8.4
    r, theta = _polar(*_same_side(x, y, phi))
    angle, ok = _arccos(r / 4)
    u = 2 * angle - math.pi
    t = theta + u / 2 + math.pi
    return (t, u, phi - t + u), ok


def _ends(u, v, xi, eta, phi):
    """Compute the lengths of the first and last arc of a word of four arcs, whose inner arcs are u
    and v.

    xi, eta: the center of the goal's circle relative to the start's circle. phi: the goal's
        heading.
    """
    delta = u - v
    a, b = jnp.sin(u) - jnp.sin(delta), jnp.cos(u) - jnp.cos(delta) - 1
    _, t = _polar(xi * a + eta * b, eta * a - xi * b)
    t = jnp.where(2 * (jnp.cos(delta) - jnp.cos(v) - jnp.cos(u)) + 3 < 0, t + math.pi, t)
    return t, t - u + v - phi


def _lrlr_outward(x, y, phi):  # 8.7: the inner arcs on both sides of one cusp
    xi, eta = _other_side(x, y, phi)
    r, _ = _polar(xi, eta)
    u, ok = _arccos((2 + r) / 4)
    t, v = _ends(u, -u, xi, eta, phi)
    return (t, u, -u, v), ok


def _lrlr_between(x, y, phi):  # 8.8: the inner arcs between two cusps
    xi, eta = _other_side(x, y, phi)
    angle, ok = _arccos((20 - xi * xi - eta * eta) / 16)
    u = -angle
    t, v = _ends(u, u, xi, eta, phi)
    return (t, u, u, v), ok


def _lrsl(x, y, phi):  # 8.9
    r, theta = _polar(*_same_side(x, y, phi))
    root, ok = _root(r * r - 4)
    t = theta + jnp.arctan2(root, -2.0)
    return (t, -QUARTER, 2 - root, phi - QUARTER - t), ok


def _lrsr(x, y, phi):  # 8.10
    xi, eta = _other_side(x, y, phi)
    r, t = _polar(-eta, xi)
    return (t, -QUARTER, 2 - r, t + QUARTER - phi), jnp.ones(r.shape, bool)


def _lrslr(x, y, phi):  # 8.11
    xi, eta = _other_side(x, y, phi)
    r, _ = _polar(xi, eta)
    root, ok = _root(r * r - 4)
    _, t = _polar(-2 * xi - root * eta, root * xi - 2 * eta)
    return (t, -QUARTER, 4 - root, -QUARTER, t - phi), ok


DUBINS = (Word("LSL", _lsl), Word("LSR", _lsr), Word("LRL", _lrl))
#: with all signs of their lengths these are the 48 words of Reeds and Shepp
REEDS_SHEPP = (
    Word("LSL", _lsl),
    Word("LSR", _lsr),
    Word("LRL", _lrl, reversible=True),
    Word("LRLR", _lrlr_outward),
    Word("LRLR", _lrlr_between),
    Word("LRSL", _lrsl, reversible=True),
    Word("LRSR", _lrsr, reversible=True),
    Word("LRSLR", _lrslr),
)
LONGEST = 5  # segments
TURN = {"L": 1, "S": 0, "R": -1}


def forwards(angle):
    """Wrap an angle to [0, 2 pi). An angle that is a full turn up to rounding gives zero."""
    full = 2 * math.pi
    angle = angle - full * jnp.floor(angle / full)
    return jnp.where(angle > full - SLACK * jnp.finfo(angle.dtype).eps, 0.0, angle)


def either_way(angle, xp=jnp):
    """Wrap an angle to [-pi, pi]."""
    return angle - 2 * math.pi * xp.round(angle / (2 * math.pi))


def candidates(
    words: tuple[Word, ...], wrap: Callable, x: jax.Array, y: jax.Array, phi: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute all candidate paths to a goal (x, y, phi) (...), for unit radius.

    wrap: `forwards` or `either_way`.

    Return lengths (..., n, 5), signed, 0 beyond the end of a word; turns (n, 5), of `TURN`; and
    which candidates exist (..., n).
    """
    # the symmetries are an axis: each formula is traced once
    flip, mirror = (jnp.asarray(signs, x.dtype) for signs in SYMMETRIES[wrap is either_way])
    x, y, phi = x[..., None], y[..., None], phi[..., None]
    back = x * jnp.cos(phi) + y * jnp.sin(phi), x * jnp.sin(phi) - y * jnp.cos(phi)
    lengths, turns, exists = [], [], []
    for kinds, formula, reversible in words:
        for order, (a, b) in ((1, (x, y)), (-1, back))[: 1 + reversible]:
            parts, ok = formula(flip * a, mirror * b, flip * mirror * phi)
            parts = [p if kind == "S" else wrap(jnp.asarray(p, x.dtype))
                     for kind, p in zip(kinds, parts, strict=True)]  # fmt: skip
            turn = [TURN[kind] for kind in kinds][::order]
            rest = LONGEST - len(parts)
            parts = [jnp.broadcast_to(flip * p, ok.shape) for p in parts[::order]]
            lengths.append(jnp.stack(parts + [jnp.zeros_like(parts[0])] * rest, -1))
            turns.append(mirror[:, None] * jnp.asarray(turn + [0] * rest, x.dtype))
            exists.append(ok)
    return jnp.concatenate(lengths, -2), jnp.concatenate(turns), jnp.concatenate(exists, -1)


#: whether the car also drives backwards -> signs of the direction, signs of the side
SYMMETRIES = {
    False: ((1, 1), (1, -1)),
    True: ((1, -1, 1, -1), (1, 1, -1, -1)),
}
