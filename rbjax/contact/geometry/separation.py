"""The direction in which two bodies of segments and discs are farthest apart.

A box is the Minkowski sum of three segments, a cylinder of a segment and a disc. With the vector d
between the centers of two bodies, all segments s g and all discs of radius r and axis a of both,

    sep(n) = n . d - sum of s |n . g| - sum of r |n - a (n . a)|
is their separation along the unit vector n. Its maximum is the signed distance: of all maxima the
least overlap counts. A maximum is at the axis of a disc, at a product of two segments, on the great
circle orthogonal to a segment, or at a smooth point of the sphere. Each kind is searched in turn:
the first two are known, a circle by samples and halvings, the sphere by samples and Newton's method
with a damping. The last step of the search is Newton's, so that its derivative is the derivative of
the maximum. (Gottschalk, Lin & Manocha 1996, for separating axes; Schneider, *Convex Bodies*, 3.5,
for zonoids.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.geometry.shapes import TINY, contact_frame, unit
from rbjax.lanes import Lane, Vec3, total
from rbjax.lanes.arrays import select

#: squared sine of the angle between two segments that count as parallel
PARALLEL_SEGMENTS = {"float64": 1e-10, "float32": 1e-6}
#: samples of half a great circle, and halvings of the interval about the best one
CIRCLE, HALVINGS = 16, 36
#: samples of the sphere, and Newton steps from the best one
SPHERE, STEPS = 64, 16

Vectors = tuple[Vec3, Lane]


class Zonoid(NamedTuple):
    """The Minkowski sum of segments and discs about a common center.

    Fields:
        segments: unit vector and half length, m, of each segment.
        discs: unit normal and radius, m, of each disc.
    """

    segments: list[Vectors]
    discs: list[Vectors]

    @property
    def size(self) -> Lane:
        """An upper bound of the distance of a point from the center, m."""
        return total(x for _, x in (*self.segments, *self.discs))

    def support(self, n: Vec3) -> Lane:
        """Compute the greatest n . x over the points x."""
        flat = total(abs_(n.dot(g)) * s for g, s in self.segments)
        return flat + total(_across(n, a)[1] * r for a, r in self.discs)

    def farthest(self, n: Vec3) -> Vec3:
        """Compute the point x with the greatest n . x, the gradient of `support`. A segment
        orthogonal to n counts with its center, a disc of axis n too."""
        out = Vec3(*(0.0 * x for x in n))
        for g, s in self.segments:
            out = out + g * (jnp.sign(n.dot(g)) * s)
        for a, r in self.discs:
            across, length = _across(n, a)
            out = out + across * jnp.where(length > 0, r / jnp.where(length > 0, length, 1.0), 0.0)
        return out

    def curvature(self, n: Vec3, x: Vec3, y: Vec3) -> tuple[Lane, Lane, Lane]:
        """Compute the second derivatives xx, xy and yy of `support` for x and y orthogonal to n."""
        xx: Lane = 0.0
        xy: Lane = 0.0
        yy: Lane = 0.0
        for a, r in self.discs:
            across, length = _across(n, a)
            length = jnp.maximum(length, TINY)
            t = a.cross(across) * (1 / length)
            tx, ty, w = t.dot(x), t.dot(y), r / length
            xx, xy, yy = xx + w * tx * tx, xy + w * tx * ty, yy + w * ty * ty
        return xx, xy, yy


class Direction(NamedTuple):
    """A direction and the separation along it.

    Fields:
        n: unit vector from the first body to the second.
        separation: m.
    """

    n: Vec3
    separation: Lane


def abs_(x: Lane) -> Lane:
    """Compute |x| with the derivative 1 at zero."""
    return jnp.where(x < 0, -x, x)


def _across(n: Vec3, a: Vec3) -> tuple[Vec3, Lane]:
    """Return the part of n orthogonal to the unit vector a, and its length."""
    across = n - a * n.dot(a)
    square = across.dot(across)
    valid = square > TINY * TINY
    return across, jnp.where(valid, jnp.sqrt(jnp.where(valid, square, 1.0)), 0.0)


def least_overlap(K: Zonoid, d: Vec3) -> Direction:
    """Return the direction of the greatest separation of two bodies.

    K: the segments and discs of both bodies. d: vector between their centers, m.
    """
    still = jax.lax.stop_gradient((K, d))
    which, start = _search(*still)
    known, _ = _known(K)
    at_known = which < len(known[0])
    n_known = Vec3(*(x[jnp.minimum(which, len(known[0]) - 1)] for x in known))
    n = select(at_known, n_known * _towards(n_known, d), _refined(K, d, start, which))
    return Direction(n, n.dot(d) - K.support(n))


def _stack(vectors: list[Vec3]) -> Vec3:
    """Return vectors as one vector of lanes (n,)."""
    return Vec3(*(jnp.stack([jnp.asarray(v[i]) for v in vectors]) for i in range(3)))


def _towards(n: Vec3, d: Vec3) -> Lane:
    """Return the sign of n . d."""
    return jnp.where(n.dot(d) < 0, -1.0, 1.0)


def _known(K: Zonoid) -> tuple[Vec3, Lane]:
    """Return the directions in which the separation may have a kink at its maximum, lanes (n,), and
    which of them exist: the axes of the discs, and the cross products of two segments."""
    g = [g for g, _ in K.segments]
    products = [a.cross(b) for i, a in enumerate(g) for b in g[i + 1 :]]
    all_ = _stack([a for a, _ in K.discs] + products)
    square = all_.dot(all_)
    valid = square > PARALLEL_SEGMENTS[square.dtype.name]
    return all_ * (1 / jnp.sqrt(jnp.where(valid, square, 1.0))), valid


def _search(K: Zonoid, d: Vec3) -> tuple[Lane, Vec3]:
    """Return the kind of the greatest maximum, and a direction close to it.

    The kind is an index: first the directions of `_known`, then the circles orthogonal to each
    segment, last the rest of the sphere.
    """
    dtype = jnp.result_type(d[0])
    scale = K.size + jnp.sqrt(d.dot(d))
    least = scale * (1e-10 if dtype == jnp.float64 else 2e-6)

    def sep(n: Vec3) -> Lane:
        return abs_(n.dot(d)) - K.support(n)

    known, valid = _known(K)
    value = jnp.where(valid, sep(known), -jnp.inf)
    which = jnp.argmax(value)
    best, start = value[which], Vec3(*(x[which] for x in known))
    start = start * _towards(start, d)

    on_circles = _best_on_circles(K, d)
    value = sep(on_circles)
    k = jnp.argmax(value)
    better = value[k] > best + least
    which = jnp.where(better, len(known[0]) + k, which)
    start = select(better, Vec3(*(x[k] for x in on_circles)), start)
    best = jnp.where(better, value[k], best)

    smooth = _best_on_sphere(K, d)
    better = smooth.separation > best + least
    which = jnp.where(better, len(known[0]) + len(K.segments), which)
    return which, select(better, smooth.n, start)


def _best_on_circles(K: Zonoid, d: Vec3) -> Vec3:
    """Return the best direction orthogonal to each segment, lanes (n,)."""
    g = _stack([g for g, _ in K.segments])
    # the least component of a unit vector is below 0.6
    e = [jnp.abs(x) < 0.6 for x in g]
    axis = Vec3(jnp.where(e[0], 1.0, 0.0), jnp.where(e[0], 0.0, jnp.where(e[1], 1.0, 0.0)),
                jnp.where(e[0] | e[1], 0.0, 1.0))  # fmt: skip
    other = unit(axis - g * g.dot(axis), Vec3(1.0, 0.0, 0.0))
    u = unit(d - g * g.dot(d), other)
    w = g.cross(u)
    step = np.pi / CIRCLE
    angles = (np.arange(CIRCLE) + 0.5) * step - np.pi / 2

    def at(angle: Lane) -> Vec3:
        return u * jnp.cos(angle) + w * jnp.sin(angle)

    def sample(i: Lane, best: tuple) -> tuple:
        angle = jnp.asarray(angles, g[0].dtype)[i]
        n = at(angle)
        value = n.dot(d) - K.support(n)
        better = value > best[0]
        return jnp.where(better, value, best[0]), jnp.where(better, angle, best[1])

    none = 0.0 * g[0]
    _, middle = jax.lax.fori_loop(0, CIRCLE, sample, (none - jnp.inf, none))

    def halve(_: Any, ends: tuple) -> tuple:
        low, high = ends
        angle = 0.5 * (low + high)
        n = at(angle)
        rising = (d - K.farthest(n)).dot(g.cross(n)) > 0
        return jnp.where(rising, angle, low), jnp.where(rising, high, angle)

    low, high = jax.lax.fori_loop(0, HALVINGS, halve, (middle - step, middle + step))
    return at(0.5 * (low + high))


def _lattice(n: int) -> np.ndarray:
    """Return n directions (n, 3) on a spiral that covers half a sphere evenly."""
    z = (np.arange(n) + 0.5) / n
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(n)
    rho = np.sqrt(1 - z * z)
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], -1)


def _best_on_sphere(K: Zonoid, d: Vec3) -> Direction:
    """Return a maximum in which no segment is orthogonal to the direction."""
    lattice = _lattice(SPHERE)
    zero = 0.0 * d[0]

    def sample(i: Lane, best: Direction) -> Direction:
        row = jnp.asarray(lattice, zero.dtype)[i]
        n = Vec3(row[0], row[1], row[2])
        n = n * _towards(n, d)
        value = n.dot(d) - K.support(n)
        return select(value > best.separation, Direction(n, value), best)

    none = Direction(Vec3(zero, zero, zero + 1.0), zero - jnp.inf)
    best = jax.lax.fori_loop(0, SPHERE, sample, none)
    scale = K.size + jnp.sqrt(d.dot(d))

    def climb(_: Any, carry: tuple) -> tuple:
        best, damping = carry
        _, x, y = contact_frame(best.n)
        step, valid = _newton(K, d, best.n, (x, y), damping)
        n = unit(best.n + step, best.n)
        value = n.dot(d) - K.support(n)
        better = valid & (value > best.separation)
        damping = jnp.where(better, 0.2 * damping, 5.0 * damping)
        return select(better, Direction(n, value), best), damping

    return jax.lax.fori_loop(0, STEPS, climb, (best, 0.1 * scale))[0]


def _newton(
    K: Zonoid, d: Vec3, n: Vec3, axes: tuple[Vec3, Vec3], damping: Lane, circle: Lane = False
) -> tuple[Vec3, Lane]:
    """Return the damped Newton step from a direction, and whether it is an ascent.

    On the sphere the second derivative of the separation is -(curvature + separation 1). On a
    circle the step is along the first of the axes, which are orthogonal to n.
    """
    x, y = axes
    slope = d - K.farthest(n)
    xx, xy, yy = K.curvature(n, x, y)
    shift = slope.dot(n) + damping
    A, C = xx + shift, jnp.where(circle, 1.0, yy + shift)
    p, q = slope.dot(x), jnp.where(circle, 0.0, slope.dot(y))
    xy = jnp.where(circle, 0.0, xy)
    det = A * C - xy * xy
    valid = (det > 0) & (A > 0)
    scale = 1 / jnp.where(valid, det, 1.0)
    return x * ((C * p - xy * q) * scale) + y * ((A * q - xy * p) * scale), valid


def _refined(K: Zonoid, d: Vec3, start: Vec3, which: Lane) -> Vec3:
    """Return the direction after one Newton step on the sphere or on a circle, or the start if the
    separation along it is greater."""
    segments = _stack([g for g, _ in K.segments])
    k = which - len(K.discs) - len(K.segments) * (len(K.segments) - 1) // 2
    circle = k < len(K.segments)
    g = Vec3(*(x[jnp.clip(k, 0, len(K.segments) - 1)] for x in segments))
    start = select(circle, unit(start - g * g.dot(start), start), start)
    _, x, y = contact_frame(start)
    x, y = select(circle, (g.cross(start), g), (x, y))
    step, valid = _newton(K, d, start, (x, y), 0.0, circle)
    moved = unit(start + step, start)
    before, after = (n.dot(d) - K.support(n) for n in (start, moved))
    slack = 16 * jnp.finfo(before.dtype).eps * (K.size + jnp.sqrt(d.dot(d) + TINY))
    return select(valid & (after >= before - slack), moved, start)
