"""Closed-form contacts between two primitive shapes.

Each function takes the two shapes in MuJoCo's order of kinds and returns a fixed list of candidate
`Contact`s. A candidate is a contact if `exists`. The normal points from the first shape to the
second. The distance is negative if the shapes overlap. The position is midway between the surfaces.

The formulas follow from the geometry. MuJoCo C gives the same contacts in the same order. A sphere
against a box, for instance, touches at the point of the box nearest to its center. (Ericson,
*Real-Time Collision Detection*, ch. 5; MuJoCo, *Computation*, "Collision detection".)
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product

import jax.numpy as jnp

from rbjax.contact.geometry.box_box import box_box
from rbjax.contact.geometry.capsule_box import capsule_box, sphere_box
from rbjax.contact.geometry.capsule_cylinder import capsule_cylinder
from rbjax.contact.geometry.cylinder_pairs import cylinder_box, cylinder_cylinder
from rbjax.contact.geometry.height_field import field_box, field_capsule, field_sphere
from rbjax.contact.geometry.plane_mesh import plane_mesh
from rbjax.contact.geometry.shapes import PARALLEL, TINY, Contact, Shape, unit
from rbjax.lanes import Lane, Vec3
from rbjax.lanes.arrays import select

Pair = Callable[[Shape, Shape, Lane], list[Contact]]


def plane_sphere(plane: Shape, sphere: Shape, reach: Lane) -> list[Contact]:
    """Return the contact of a plane and a sphere."""
    return [_plane_ball(plane.p, plane.axis, sphere.p, sphere.size[0], reach)]


def plane_capsule(plane: Shape, capsule: Shape, reach: Lane) -> list[Contact]:
    """Return the contacts of a plane with the two end spheres of a capsule."""
    n, a = plane.axis, capsule.axis
    half = a * capsule.size[1]
    ends = (capsule.p + half, capsule.p - half)
    found = [_plane_ball(plane.p, n, end, capsule.size[0], reach) for end in ends]
    return [contact._replace(tangent=a) for contact in found]


def plane_ellipsoid(plane: Shape, ellipsoid: Shape, reach: Lane) -> list[Contact]:
    """Return the contact of a plane with the lowest point of an ellipsoid."""
    n, s = plane.axis, ellipsoid.size
    scaled = s.entrywise(ellipsoid.R.T @ n)
    lowest = ellipsoid.p - ellipsoid.R @ s.entrywise(unit(scaled, Vec3(0.0, 0.0, 1.0)))
    return [_above_plane(plane, lowest, reach)]


def plane_cylinder(plane: Shape, cylinder: Shape, reach: Lane) -> list[Contact]:
    """Return up to four contacts of a plane with the rims of a cylinder.

    They are the lowest points of the lower and of the upper rim, and the two points of the lower
    rim that form an equilateral triangle with the first.
    """
    n = plane.axis
    radius, half = cylinder.size[0], cylinder.size[1]
    a = cylinder.axis
    down = a.dot(n)
    flip = jnp.where(down > 0, -1.0, 1.0)
    a, down = a * flip, down * flip
    across = a * down - n
    v = unit(across, cylinder.R.columns[0]) * radius
    a = a * half
    w = unit(v.cross(a), Vec3(1.0, 0.0, 0.0)) * (radius * (math.sqrt(3) / 2))
    points = (v + a, v - a, w + a - v * 0.5, a - w - v * 0.5)
    found = [_above_plane(plane, cylinder.p + x, reach) for x in points]
    return [found[0], *(c._replace(exists=c.exists & found[0].exists) for c in found[1:])]


def plane_box(plane: Shape, box: Shape, reach: Lane) -> list[Contact]:
    """Return up to four contacts of a plane with the corners of a box, of its eight candidates.

    Only corners not above the center count. If more than four are within reach, the first four are
    contacts.
    """
    n, sides = plane.axis, [c * s for c, s in zip(box.R.columns, box.size, strict=True)]
    out: list[Contact] = []
    count: Lane = 0
    for sz, sy, sx in product((-1.0, 1.0), repeat=3):
        corner = sides[0] * sx + sides[1] * sy + sides[2] * sz
        found = _above_plane(plane, box.p + corner, reach)
        exists = found.exists & (n.dot(corner) <= 0) & (count < 4)
        count = count + jnp.asarray(exists, jnp.int32)
        out.append(found._replace(exists=exists))
    return out


def sphere_sphere(one: Shape, other: Shape, reach: Lane) -> list[Contact]:
    """Return the contact of two spheres."""
    return [_balls(one, other, one.p, one.size[0], other.p, other.size[0], reach)]


def sphere_capsule(sphere: Shape, capsule: Shape, reach: Lane) -> list[Contact]:
    """Return the contact of a sphere with the nearest sphere about the axis of a capsule."""
    a, half = capsule.axis, capsule.size[1]
    x = jnp.clip(a.dot(sphere.p - capsule.p), -half, half)
    center = capsule.p + a * x
    return [_balls(sphere, capsule, sphere.p, sphere.size[0], center, capsule.size[0], reach)]


def sphere_cylinder(sphere: Shape, cylinder: Shape, reach: Lane) -> list[Contact]:
    """Return the contact of a sphere with the side, a cap or a rim of a cylinder."""
    a, radius, half = cylinder.axis, cylinder.size[0], cylinder.size[1]
    v = sphere.p - cylinder.p
    x = a.dot(v)
    radial = v - a * x
    outward = unit(radial, Vec3(1.0, 0.0, 0.0))
    off = radial.dot(outward)
    in_height, in_radius = jnp.abs(x) < half, off < radius
    cap_is_nearer = half - jnp.abs(x) < radius - off
    side = in_height & ~(in_radius & cap_is_nearer)
    cap = in_radius & ~side
    end = a * jnp.where(x > 0, 1.0, -1.0)

    r = sphere.size[0]
    on_axis, on_rim = cylinder.p + a * x, cylinder.p + end * half + outward * radius
    ball = _balls(
        sphere, cylinder, sphere.p, r, select(side, on_axis, on_rim),
        jnp.where(side, radius, 0.0), reach,
    )  # fmt: skip
    flat = _plane_ball(cylinder.p + end * half, end, sphere.p, r, reach)
    return [select(cap, flat._replace(normal=-flat.normal), ball)]


def capsule_capsule(one: Shape, other: Shape, reach: Lane) -> list[Contact]:
    """Return the contact of two capsules at the nearest points of their axes.

    Parallel capsules have two contacts, at the ends of the first axis.
    """
    a, c = (x.p - x.axis * x.size[1] for x in (one, other))
    ab, cd = (x.axis * (2.0 * x.size[1]) for x in (one, other))
    ca = a - c
    d1, d2 = (jnp.maximum(x.dot(x), TINY) for x in (ab, cd))
    d3, d4, d5 = cd.dot(ca), ab.dot(ca), ab.dot(cd)
    X = ab.cross(cd)
    det = X.dot(X)
    skew = det > PARALLEL * d1 * d2

    def at(s: Lane, exists: Lane) -> Contact:
        t = (d5 * s + d3) / d2
        s = jnp.where(t < 0, jnp.clip(-d4 / d1, 0.0, 1.0), s)
        s = jnp.where(t > 1, jnp.clip((d5 - d4) / d1, 0.0, 1.0), s)
        t = jnp.clip(t, 0.0, 1.0)
        found = _balls(one, other, a + ab * s, one.size[0], c + cd * t, other.size[0], reach)
        return found._replace(exists=found.exists & exists)

    s = jnp.clip(X.dot(cd.cross(ca)) / jnp.where(skew, det, 1.0), 0.0, 1.0)
    return [at(jnp.where(skew, s, 0.0), True), at(jnp.ones_like(s), ~skew)]


PAIRS: dict[tuple[str, str], Pair] = {
    ("plane", "sphere"): plane_sphere,
    ("plane", "capsule"): plane_capsule,
    ("plane", "ellipsoid"): plane_ellipsoid,
    ("plane", "cylinder"): plane_cylinder,
    ("plane", "box"): plane_box,
    ("plane", "mesh"): plane_mesh,
    ("hfield", "sphere"): field_sphere,
    ("hfield", "capsule"): field_capsule,
    ("hfield", "box"): field_box,
    ("sphere", "sphere"): sphere_sphere,
    ("sphere", "capsule"): sphere_capsule,
    ("sphere", "cylinder"): sphere_cylinder,
    ("sphere", "box"): sphere_box,
    ("capsule", "capsule"): capsule_capsule,
    ("capsule", "cylinder"): capsule_cylinder,
    ("capsule", "box"): capsule_box,
    ("cylinder", "cylinder"): cylinder_cylinder,
    ("cylinder", "box"): cylinder_box,
    ("box", "box"): box_box,
}

#: the order of the kinds of geoms in a pair
KINDS = ("plane", "hfield", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "sdf")

#: candidates of each pair
COUNTS = dict.fromkeys(PAIRS, 1) | {
    ("plane", "capsule"): 2, ("plane", "cylinder"): 4, ("plane", "box"): 8, ("plane", "mesh"): 4,
    ("hfield", "capsule"): 2, ("hfield", "box"): 8,
    ("capsule", "capsule"): 2, ("capsule", "cylinder"): 2, ("capsule", "box"): 2, ("box", "box"): 8,
    ("cylinder", "cylinder"): 4, ("cylinder", "box"): 4,
}  # fmt: skip


def _above_plane(plane: Shape, point: Vec3, reach: Lane) -> Contact:
    """Return the contact of a plane with a point of another shape."""
    n = plane.axis
    distance = n.dot(point - plane.p)
    return Contact(distance, point - n * (0.5 * distance), n, distance <= reach)


def _plane_ball(p: Vec3, n: Vec3, center: Vec3, radius: Lane, reach: Lane) -> Contact:
    """Return the contact of a plane through p with a sphere."""
    height = n.dot(center - p)
    distance = height - radius
    return Contact(distance, center - n * (radius + 0.5 * distance), n, distance <= reach)


def _balls(
    one: Shape, other: Shape, c1: Vec3, r1: Lane, c2: Vec3, r2: Lane, reach: Lane
) -> Contact:
    """Return the contact of two spheres that belong to two shapes.

    If the centers coincide, the normal is orthogonal to the axes of the shapes.
    """
    d = c2 - c1
    apart = unit(one.axis.cross(other.axis), Vec3(1.0, 0.0, 0.0))
    n = unit(d, apart)
    gap = d.dot(n)
    gap = jnp.where(d.dot(d) > TINY * TINY, gap, 0.0)
    distance = gap - r1 - r2
    return Contact(distance, c1 + n * (r1 + 0.5 * distance), n, distance <= reach)
