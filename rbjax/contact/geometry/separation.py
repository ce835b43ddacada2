"""The direction in which two bodies of segments and discs are farthest apart.

A box is the Minkowski sum of three segments, a cylinder of a segment and a disc. With the vector d
between the centers of two bodies, all segments s g and all discs of radius r and axis a of both,

    sep(n) = n . d - sum of s |n . g| - sum of r |n - a (n . a)|
is their separation along the unit vector n. Its maximum is the signed distance: of all maxima the
least overlap counts. A maximum is at the axis of a disc, at a product of two segments, on the great
circle orthogonal to a segment, or at a smooth point of the sphere. The directions of the first two
kinds are known. On each circle and on the sphere, damped Newton steps start from the best of many
directions. The last step has the derivative of the maximum. (Gottschalk, Lin & Manocha 1996, for
separating axes; Schneider, *Convex Bodies*, 3.5, for zonoids.)
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.contact.geometry.shapes import TINY, contact_frame, unit
from rbjax.lanes import Lane, Vec3, total
from rbjax.lanes.arrays import select

#: squared sine of the angle between two segments that count as parallel
PARALLEL_SEGMENTS = {"float64": 1e-10, "float32": 1e-6}
#: directions of half a sphere, Newton steps from the best one, and further ones of the greatest
SAMPLES, FIRST, STEPS = 40, 8, 12
#: damping of the first step relative to the size, and its factor after a rise and after none
DAMPING, RISE, NO_RISE = 0.1, 0.1, 8.0

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
    known, valid = _known(K)
    # the normals of the circles, and zero for the sphere
    normals = _stack([Vec3(*(0.0 * x for x in d)), *(g for g, _ in K.segments)])
    start, k, which = _search(*jax.lax.stop_gradient((K, d, known, valid, normals)))
    last, _ = _climb(K, d, start.n, _entry(normals, k), 0.0)
    n = _entry(known, which)
    slack = 16 * jnp.finfo(start.separation.dtype).eps * (K.size + jnp.sqrt(d.dot(d)))
    better = last.dot(d) - K.support(last) >= start.separation - slack
    n = select(which < 0, select(better, last, start.n), n * _towards(n, d))
    return Direction(n, n.dot(d) - K.support(n))


def _stack(vectors: list[Vec3]) -> Vec3:
    """Return vectors as one vector of lanes (n,)."""
    return Vec3(*(jnp.stack([jnp.asarray(v[i]) for v in vectors]) for i in range(3)))


def _entry(vectors: Vec3, k: Lane) -> Vec3:
    """Return one of the vectors in lanes (n,), the first or last if the index k is out of range."""
    return Vec3(*(x[jnp.clip(k, 0, len(x) - 1)] for x in vectors))


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


def _search(
    K: Zonoid, d: Vec3, known: Vec3, valid: Lane, normals: Vec3
) -> tuple[Direction, Lane, Lane]:
    """Return the greatest maximum on the sphere and the circles, the index of its circle, and the
    index of a known direction whose separation is not less, -1 if there is none."""
    scale = K.size + jnp.sqrt(d.dot(d))
    lattice = jnp.asarray(_lattice(SAMPLES), d[0].dtype)

    def towards(n: Vec3) -> Direction:
        n = n * _towards(n, d)
        return Direction(n, n.dot(d) - K.support(n))

    def sample(i: Lane, best: Direction) -> Direction:
        found = towards(_across_normal(Vec3(*(lattice[i, k] for k in range(3))), normals))
        return select(found.separation > best.separation, found, best)

    def climb(normal: Vec3, _: Any, carry: tuple) -> tuple:
        best, damping = carry
        n, rises = _climb(K, d, best.n, normal, damping)
        found = Direction(n, n.dot(d) - K.support(n))
        better = rises & (found.separation > best.separation)
        damping = damping * jnp.where(better, RISE, NO_RISE)
        return select(better, found, best), damping

    none = 0.0 * normals[0]
    best = jax.lax.fori_loop(0, SAMPLES, sample, Direction(normals, none - jnp.inf))
    start = best, none + DAMPING * scale
    best, damping = jax.lax.fori_loop(0, FIRST, functools.partial(climb, normals), start)
    least = scale * (1e-10 if scale.dtype == jnp.float64 else 2e-6)
    k = jnp.argmax(best.separation - jnp.where(jnp.arange(len(none)) == 0, least, 0.0))
    start = jax.tree.map(lambda x: x[k], (best, damping))
    climb_on = functools.partial(climb, _entry(normals, k))
    best, _ = jax.lax.fori_loop(0, STEPS, climb_on, start)
    values = jnp.where(valid, towards(known).separation, -jnp.inf)
    which = jnp.argmax(values)
    return best, k, jnp.where(values[which] >= best.separation - least, which, -1)


def _lattice(n: int) -> np.ndarray:
    """Return n directions (n, 3) on a spiral that covers half a sphere evenly."""
    z = (np.arange(n) + 0.5) / n
    angle = np.pi * (1 + np.sqrt(5)) * np.arange(n)
    rho = np.sqrt(1 - z * z)
    return np.stack([rho * np.cos(angle), rho * np.sin(angle), z], -1)


def _across_normal(n: Vec3, normal: Vec3) -> Vec3:
    """Return the direction on the circle with a normal that is nearest to n; n if it is zero."""
    return unit(n - normal * normal.dot(n), n)


def _climb(K: Zonoid, d: Vec3, n: Vec3, normal: Vec3, damping: Lane) -> tuple[Vec3, Lane]:
    """Return the direction after a damped Newton step on the circle with a normal, or on the sphere
    if it is zero, and whether the step is an ascent. If not, there is no step.

    The second derivative of the separation is -(curvature + separation 1).
    """
    n = _across_normal(n, normal)
    circle = normal.dot(normal) > 0.5
    _, x, y = contact_frame(n)
    x, y = select(circle, (normal.cross(n), normal), (x, y))
    slope = d - K.farthest(n)
    xx, xy, yy = K.curvature(n, x, y)
    shift = slope.dot(n) + damping
    A, B, C = xx + shift, jnp.where(circle, 0.0, xy), jnp.where(circle, 1.0, yy + shift)
    p, q = slope.dot(x), jnp.where(circle, 0.0, slope.dot(y))
    det = A * C - B * B
    rises = (det > 0) & (A > 0)
    scale = jnp.where(rises, 1 / jnp.where(rises, det, 1.0), 0.0)
    return unit(n + x * ((C * p - B * q) * scale) + y * ((A * q - B * p) * scale), n), rises
