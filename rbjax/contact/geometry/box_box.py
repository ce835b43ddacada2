"""Contacts of two boxes: separating axes, then the clipped face or the two nearest edges.

The axis of least overlap is a face normal of either box or a product of two edges.
A face axis gives the polygon in which the incident face, which is the most opposed face of the
other box, meets the prism over the reference face. An edge axis gives one contact. (Gottschalk, Lin
& Manocha 1996; Sutherland & Hodgman 1974; Ericson, *Real-Time Collision Detection*, 4.4.)
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

from rbjax.contact.geometry.shapes import Contact, Shape
from rbjax.lanes import Lane, Vec3
from rbjax.lanes.arrays import matmat, matvec

#: vertices of the clipped face, at most
VERTICES = 8
#: squared length of the product of two edges that counts as parallel
PARALLEL_EDGES = 1e-16


def box_box(one: Shape, other: Shape, reach: Lane) -> list[Contact]:
    """Return up to eight contacts of two boxes."""
    R = jnp.stack([_matrix(x) for x in (one, other)])
    p = jnp.stack([x.p.array for x in (one, other)])
    s = jnp.stack([x.size.array for x in (one, other)])
    d = p[1] - p[0]

    faces = jnp.concatenate([R[0].T, R[1].T])
    edges = jnp.cross(R[0].T[:, None], R[1].T[None]).reshape(9, 3)
    square = (edges * edges).sum(-1)
    skew = square > PARALLEL_EDGES
    edges = edges / jnp.sqrt(jnp.where(skew, square, 1.0))[:, None]
    axes = jnp.concatenate([faces, edges])
    axes = axes * jnp.where(matvec(axes, d) < 0, -1.0, 1.0)[:, None]
    extent = sum(matvec(jnp.abs(matmat(axes, R[k])), s[k]) for k in (0, 1))
    separation = matvec(axes, d) - extent
    separation = jnp.where(jnp.concatenate([jnp.ones(6, bool), skew]), separation, -jnp.inf)

    face = jnp.argmax(separation[:6])
    on_face = separation[face]
    edge, on_edge = _best_edge(separation[6:], on_face)
    axis = axes[6 + edge]
    alike = jnp.abs((axis * axes[face]).sum()) > 0.99
    alike &= on_edge < on_face + 0.05 * jnp.abs(on_face) + 1e-15
    by_edge = (edge >= 0) & ~alike
    apart = jnp.max(separation) > reach + 1e-13 * s.sum()

    clipped = _face_contacts(R, p, s, axes[face], face, reach)
    midpoint = _edge_midpoint(R, p, s, axis, jnp.maximum(edge, 0))
    out = []
    for k in range(VERTICES):
        distance, position, normal, exists = (x[k] for x in clipped)
        if k == 0:
            distance = jnp.where(by_edge, on_edge, distance)
            position = jnp.where(by_edge, midpoint, position)
            normal = jnp.where(by_edge, axis, normal)
            exists = jnp.where(by_edge, on_edge <= reach, exists)
        else:
            exists = exists & ~by_edge
        out.append(Contact(distance, Vec3(*position), Vec3(*normal), exists & ~apart))
    return out


def _matrix(shape: Shape) -> jax.Array:
    """Return the rotation of a shape as an array (3, 3)."""
    return jnp.stack([jnp.asarray(x) for x in shape.R]).reshape(3, 3)


def _best_edge(separation: jax.Array, on_face: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the edge axis (index 0 to 8) that separates the boxes more than any face, and its
    separation. If there is none, the index is -1 and the separation is `on_face`."""
    best, index = on_face, jnp.int32(-1)
    for k in range(9):
        better = separation[k] > best + 1e-6 * jnp.abs(best)
        best = jnp.where(better, separation[k], best)
        index = jnp.where(better, k, index)
    return index, best


def _edge_midpoint(
    R: jax.Array, p: jax.Array, s: jax.Array, axis: jax.Array, edge: jax.Array
) -> jax.Array:
    """Return the midpoint between the nearest points of two box edges.

    axis: direction of separation. edge: 3 i + j for edge directions i and j of the boxes.
    """
    i, j = edge // 3, edge % 3
    points, along = [], []
    for k, (which, sign) in enumerate(((i, 1.0), (j, -1.0))):
        towards = jnp.where(matvec(R[k].T, axis) < 0, -1.0, 1.0) * sign
        corner = jnp.where(jnp.arange(3) == which, 0.0, towards * s[k])
        points.append(p[k] + matvec(R[k], corner))
        along.append(R[k][:, which])
    between = points[1] - points[0]
    cosine = (along[0] * along[1]).sum()
    b0, b1 = ((a * between).sum() for a in along)
    limits = s[0][i], s[1][j]
    t0 = _clamped((b0 - cosine * b1) / jnp.maximum(1 - cosine * cosine, 1e-12), limits[0])
    t1 = _clamped(cosine * t0 - b1, limits[1])
    t0 = _clamped(cosine * t1 + b0, limits[0])
    return 0.5 * (points[0] + along[0] * t0 + points[1] + along[1] * t1)


def _clamped(x: jax.Array, limit: jax.Array) -> jax.Array:
    return jnp.clip(x, -limit, limit)


def _face_contacts(
    R: jax.Array, p: jax.Array, s: jax.Array, normal: jax.Array, face: jax.Array, reach: Lane
) -> tuple[jax.Array, ...]:
    """Clip the face of one box that faces a face of the other. Return distances, positions, normals
    and existence of the vertices.

    face: index of the reference face's axis, 0 to 2 of the first box and 3 to 5 of the second.
    """
    second = face >= 3
    k = face % 3
    ref, inc = jnp.where(second, 1, 0), jnp.where(second, 0, 1)
    outward = jnp.where(second, -normal, normal)
    x, y = R[ref][:, (k + 1) % 3], R[ref][:, (k + 2) % 3]
    sx, sy = s[ref][(k + 1) % 3], s[ref][(k + 2) % 3]
    origin = p[ref] + outward * s[ref][k]

    facing = matvec(R[inc].T, outward)
    i = jnp.argmax(jnp.abs(facing))
    side = jnp.where(facing[i] > 0, -1.0, 1.0)
    center = p[inc] + R[inc][:, i] * (side * s[inc][i])
    u, w = (
        R[inc][:, (i + 1) % 3] * s[inc][(i + 1) % 3],
        R[inc][:, (i + 2) % 3] * s[inc][(i + 2) % 3],
    )
    corners = jnp.stack([center + a * u + b * w for a, b in ((1, 1), (-1, 1), (-1, -1), (1, -1))])
    local = matmat(corners - origin, jnp.stack([x, y, outward], 1))

    polygon = jnp.concatenate([local, jnp.zeros((VERTICES - 4, 3), local.dtype)])
    count = jnp.int32(4)
    for axis, sign, limit in ((0, 1.0, sx), (0, -1.0, sx), (1, 1.0, sy), (1, -1.0, sy)):
        polygon, count = clip_polygon(polygon, count, limit - sign * polygon[:, axis])
    exists = (jnp.arange(VERTICES) < count) & (polygon[:, 2] <= reach)
    exists &= ~repeated(polygon, count, 1e-7 * jnp.sqrt(sx * sx + sy * sy))
    height = polygon[:, 2]
    position = origin + polygon[:, :1] * x + polygon[:, 1:2] * y + (0.5 * height)[:, None] * outward
    return height, position, jnp.broadcast_to(normal, (VERTICES, 3)), exists


def clip_polygon(
    polygon: jax.Array, count: jax.Array, inside: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Clip a polygon to the half-space inside >= 0. Return its vertices and their number.

    inside: a linear function at the vertices. count: number of vertices.
    """
    index = jnp.arange(VERTICES)
    following = jnp.where(index + 1 < count, index + 1, 0) % VERTICES
    after, f, g = polygon[following], inside, inside[following]
    used = index < count
    kept = used & (f >= 0)
    crossing = used & ((f >= 0) != (g >= 0))
    share = f / jnp.where(crossing, f - g, 1.0)
    crossed = polygon + share[:, None] * (after - polygon)
    points = jnp.stack([polygon, crossed], 1).reshape(2 * VERTICES, 3)
    valid = jnp.stack([kept, crossing], 1).reshape(-1)
    place = jnp.where(valid, jnp.cumsum(valid) - 1, VERTICES)
    slot = place[None] == index[:, None]
    return jnp.where(slot[..., None], points[None], 0.0).sum(1), jnp.minimum(valid.sum(), VERTICES)


def repeated(polygon: jax.Array, count: jax.Array, least: jax.Array) -> jax.Array:
    """Return a mask of the vertices that are nearer than `least` to an earlier vertex."""
    gap = jnp.linalg.norm(polygon[:, None, :2] - polygon[None, :, :2], axis=-1)
    index = jnp.arange(VERTICES)
    earlier = (index[None] < index[:, None]) & (index[None] < count)
    return (earlier & (gap < least)).any(1)
