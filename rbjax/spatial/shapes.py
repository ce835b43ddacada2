"""Mass, centre of mass and inertia of solids, from their dimensions and density or mass.

Lengths are in m. A shape is at the origin with its axis along z. Use `transform_properties` to move
it. Density is in kg/m^3 (kg/m^2 for a plate, kg/m for a rod). Dimensions may be batches, and all
results are differentiable in them. `combine` joins bodies, and `hole` makes one of them empty:

    combine([box([1.0, 1.0, 1.0], density=700.0), hole(sphere(0.2, density=700.0))])

The integrals over a closed triangle mesh are sums over signed tetrahedra, each spanned by a
triangle and one common point (Mirtich, 1996). For a tetrahedron (0, a, b, c) with volume
V = a . (b x c) / 6 and s = a + b + c

    int x dV = V s / 4,    int x x^T dV = V (a a^T + b b^T + c c^T + s s^T) / 20
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.rotations.arguments import check_positive, checked, entries, stacked, takes
from rbjax.spatial.mass import MassProperties, parallel_axes

__all__ = [
    "box", "capsule", "combine", "cone", "cylinder", "ellipsoid", "hole", "mesh", "plate",
    "points", "rod", "sphere", "tube",
]  # fmt: skip

Maybe = jax.Array | None


def _solid(**dimensions: str) -> Callable[[Callable], Callable]:
    """Return a decorator that checks the dimensions of a shape, its density and its mass."""
    positive = (*dimensions, "density", "mass")
    return takes(positive=positive, density="scalar", mass="scalar", **dimensions)


@_solid(size="vector")
def box(size: jax.Array, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    """Compute the mass properties of a box with edges `size` (..., 3) and its center at the origin.

    >>> box([1.0, 2.0, 3.0], density=2.0).inertia.diagonal().tolist()
    [13.0, 10.0, 5.0]
    """
    a, b, c = entries(size)
    xx, yy, zz = a * a / 12, b * b / 12, c * c / 12
    return _body(a * b * c, [0.0, 0.0, 0.0], [yy + zz, xx + zz, xx + yy], density, mass)


@_solid(semi_axes="vector")
def ellipsoid(semi_axes: jax.Array, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    """Compute the mass properties of an ellipsoid with semi-axes (..., 3) about its center.

    >>> ellipsoid([1.0, 2.0, 3.0], mass=5.0).inertia.diagonal().tolist()
    [13.0, 10.0, 5.0]
    """
    a, b, c = entries(semi_axes)
    xx, yy, zz = a * a / 5, b * b / 5, c * c / 5
    volume = 4 / 3 * jnp.pi * a * b * c
    return _body(volume, [0.0, 0.0, 0.0], [yy + zz, xx + zz, xx + yy], density, mass)


@_solid(radius="scalar")
def sphere(radius: jax.Array, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    """Compute the mass properties of a solid sphere about its center: I = 2/5 m r^2.

    >>> sphere(1.0, mass=5.0).inertia.diagonal().tolist()
    [2.0, 2.0, 2.0]
    """
    I = 2 / 5 * radius * radius
    return _body(4 / 3 * jnp.pi * radius**3, [0.0, 0.0, 0.0], [I, I, I], density, mass)


@_solid(radius="scalar", length="scalar")
def cylinder(
    radius: jax.Array, length: jax.Array, *, density: Maybe = None, mass: Maybe = None
) -> MassProperties:
    """Compute the mass properties of a cylinder along z about its center.

    >>> cylinder(1.0, 3.0, mass=2.0).inertia.diagonal().tolist()
    [2.0, 2.0, 1.0]
    """
    return _tube(radius, jnp.zeros_like(radius), length, density, mass)


def tube(
    outer: jax.Array,
    inner: jax.Array,
    length: jax.Array,
    *,
    density: Maybe = None,
    mass: Maybe = None,
) -> MassProperties:
    """Compute the mass properties of a tube with outer and inner radius along z about its center.

    >>> tube(2.0, 1.0, 3.0, mass=2.0).inertia.diagonal().tolist()
    [4.0, 4.0, 5.0]
    """
    check_positive("tube", outer=outer, inner=inner, length=length, density=density, mass=mass)
    outer = checked("tube", "outer", outer, "scalar")
    inner = checked("tube", "inner", inner, "scalar")
    known = not any(isinstance(x, jax.core.Tracer) for x in (outer, inner))
    if known and (np.asarray(outer) <= np.asarray(inner)).any():
        raise InputError(f"tube: inner is {inner} and outer {outer}, expected inner < outer")
    return _bored(outer, inner, length, density=density, mass=mass)


@_solid(radius="scalar", length="scalar")
def capsule(
    radius: jax.Array, length: jax.Array, *, density: Maybe = None, mass: Maybe = None
) -> MassProperties:
    """Compute the mass properties of a capsule about its center.

    It is a cylinder of `length` along z with a hemisphere at each end.

    >>> round(float(capsule(1.0, 3.0, density=3 / jnp.pi).mass), 6)
    13.0
    """
    r, l = radius, length
    trunk, caps = jnp.pi * r * r * l, 4 / 3 * jnp.pi * r**3
    volume = trunk + caps
    along = (trunk * r * r / 2 + caps * 2 / 5 * r * r) / volume
    # the inertia of the two hemispheres about the center is 2/5 r^2 + l^2/4 + 3/8 r l, for mass 1
    across = trunk * (r * r / 4 + l * l / 12) + caps * (2 / 5 * r * r + l * l / 4 + 3 / 8 * r * l)
    across = across / volume
    return _body(volume, [0.0, 0.0, 0.0], [across, across, along], density, mass)


@_solid(radius="scalar", height="scalar")
def cone(
    radius: jax.Array, height: jax.Array, *, density: Maybe = None, mass: Maybe = None
) -> MassProperties:
    """Compute the mass properties of a cone with its base at z = 0 and its tip at z = height.

    >>> cone(2.0, 4.0, mass=10.0).com.tolist(), cone(2.0, 4.0, mass=10.0).inertia[2, 2].item()
    ([0.0, 0.0, 1.0], 12.0)
    """
    r, h = radius, height
    across, along = 3 / 20 * r * r + 3 / 80 * h * h, 3 / 10 * r * r
    volume = jnp.pi * r * r * h / 3
    return _body(volume, [0.0, 0.0, h / 4], [across, across, along], density, mass)


@_solid(length="scalar")
def rod(length: jax.Array, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    """Compute the mass properties of a thin rod along z about its center; density in kg/m.

    >>> rod(2.0, mass=3.0).inertia.diagonal().tolist()
    [1.0, 1.0, 0.0]
    """
    I = length * length / 12
    return _body(length, [0.0, 0.0, 0.0], [I, I, jnp.zeros_like(I)], density, mass)


@_solid(size="pair")
def plate(size: jax.Array, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    """Compute the mass properties of a thin plate about its center; density in kg/m^2.

    `size` (..., 2) is the edges along x and y.

    >>> plate([2.0, 4.0], mass=3.0).inertia.diagonal().tolist()
    [4.0, 1.0, 5.0]
    """
    a, b = entries(size)
    xx, yy = a * a / 12, b * b / 12
    return _body(a * b, [0.0, 0.0, 0.0], [yy, xx, xx + yy], density, mass)


def combine(parts: Sequence[MassProperties]) -> MassProperties:
    """Join the mass properties of bodies, which may be holes, in one common frame.

    >>> two = [MassProperties(jnp.array(1.0), jnp.array([x, 0.0, 0.0]), jnp.zeros((3, 3)))
    ...        for x in (-1.0, 3.0)]
    >>> combine(two).com.tolist(), combine(two).inertia.diagonal().tolist()
    ([1.0, 0.0, 0.0], [0.0, 8.0, 8.0])
    """
    given = list(parts) if isinstance(parts, Sequence) else parts
    if not isinstance(given, list) or not all(isinstance(part, MassProperties) for part in given):
        got = [type(x).__name__ for x in given] if isinstance(given, list) else type(parts).__name__
        raise InputError(f"combine: parts is {got}, expected a sequence of MassProperties")
    if not given:
        raise InputError("combine: parts is empty, expected at least one MassProperties")
    parts = given
    mass = sum((part.mass for part in parts[1:]), start=parts[0].mass)
    moment = sum(part.mass[..., None] * part.com for part in parts)
    com = moment / mass[..., None]
    about = [parallel_axes(p.inertia, p.mass, p.com - com) for p in parts]
    return MassProperties(mass, com, sum(about[1:], start=about[0]))


def hole(part: MassProperties) -> MassProperties:
    """Return a part with negative mass and inertia, which `combine` subtracts."""
    if not isinstance(part, MassProperties):
        raise InputError(f"hole: part is {type(part).__name__}, expected MassProperties")
    return MassProperties(-part.mass, part.com, -part.inertia)


@takes(outer="scalar", inner="scalar", length="scalar", density="scalar", mass="scalar")
def _bored(outer, inner, length, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    return _tube(outer, inner, length, density, mass)


def _tube(outer, inner, length, density: Maybe, mass: Maybe) -> MassProperties:
    square = outer * outer + inner * inner
    volume = jnp.pi * (outer - inner) * (outer + inner) * length
    across = square / 4 + length * length / 12
    return _body(volume, [0.0, 0.0, 0.0], [across, across, square / 2], density, mass)


def _check_one_of(where: str, density: Any, mass: Any) -> None:
    if (density is None) == (mass is None):
        both = "neither" if mass is None else "both"
        raise InputError(f"{where}got {both} of density and mass, expected exactly one")


def _body(volume, com: list, moments: list, density: Maybe, mass: Maybe) -> MassProperties:
    """Compute mass properties from volume (area, length), center of mass and principal moments. The
    moments are about the center of mass, for unit mass."""
    _check_one_of("", density, mass)
    if mass is not None:
        total = jnp.broadcast_to(mass, jnp.broadcast_shapes(mass.shape, volume.shape))
    else:
        total = density * volume
    a, b, c = (total * x for x in moments)
    where = [jnp.broadcast_to(jnp.asarray(x, total.dtype), total.shape) for x in com]
    return MassProperties(total, stacked(where), stacked([a, 0, 0, 0, b, 0, 0, 0, c], 3, 3))


def mesh(
    vertices: jax.Array,
    triangles: np.ndarray,
    *,
    density: jax.Array | None = None,
    mass: jax.Array | None = None,
) -> MassProperties:
    """Compute the mass properties of the solid inside a closed triangle mesh.

    Args:
        vertices: (n, 3), m; the result is differentiable in them.
        triangles: (m, 3) vertex indices, counter-clockwise seen from outside.
        density, mass: exactly one of both, a scalar.

    Raises:
        InputError: the surface is open or inside out.

    >>> corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    >>> solid = mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], density=6.0)
    >>> round(float(solid.mass), 6), solid.com.round(6).tolist()
    (1.0, [0.25, 0.25, 0.25])
    """
    check_positive("mesh", density=density, mass=mass)
    _check_one_of("mesh: ", density, mass)
    for name, x in (("density", density), ("mass", mass)):
        if x is not None and checked("mesh", name, x, "scalar").ndim:
            raise InputError(f"mesh: {name} has shape {jnp.shape(x)}, expected a number")
    corners = checked("mesh", "vertices", vertices, "vector")
    volume, com, second = _integrals(corners, _closed(triangles, len(corners)))
    if not isinstance(volume, jax.core.Tracer) and not volume > 0:
        raise InputError(
            f"mesh: the volume is {float(volume):g}, expected more than zero; a negative volume "
            f"means that triangles are clockwise seen from outside: reverse each"
        )
    scale = jnp.asarray(density) if mass is None else jnp.asarray(mass) / volume
    total = jnp.asarray(mass) if density is None else scale * volume
    return MassProperties(total, com, scale * _inertia(second))


def points(positions: jax.Array, masses: jax.Array) -> MassProperties:
    """Compute the mass properties of rigidly connected particles at (n, 3) with masses (n,).

    >>> points([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]], [1.0, 1.0]).inertia.diagonal().tolist()
    [0.0, 2.0, 2.0]
    """
    positions = checked("points", "positions", positions, "vector")
    weights = checked("points", "masses", masses, "scalar")
    if positions.ndim != 2:
        raise InputError(f"points: positions has shape {positions.shape}, expected (n, 3)")
    if weights.shape != positions.shape[:1]:
        raise InputError(f"points: masses has shape {weights.shape}, expected ({len(positions)},)")
    return _points(positions, weights[:, None])


@takes(positions="vector", weights="scalar")
def _points(positions: jax.Array, weights: jax.Array) -> MassProperties:
    mass = weights.sum()
    com = (weights * positions).sum(0) / mass
    r = positions - com
    second = (weights[..., None] * r[:, :, None] * r[:, None, :]).sum(0)
    return MassProperties(mass, com, _inertia(second))


def _inertia(second: jax.Array) -> jax.Array:
    """Compute the inertia tr(S) 1 - S from the second moment S."""
    return jnp.trace(second) * jnp.eye(3, dtype=second.dtype) - second


@jax.jit
def _integrals(vertices: jax.Array, index: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Compute the volume, the centroid and the second moment about it, for density 1."""
    middle = vertices.mean(0)  # a point near the solid, which avoids cancellation
    a, b, c = (vertices[index[:, k]] - middle for k in range(3))
    V = (a * jnp.cross(b, c)).sum(-1) / 6
    s = a + b + c
    volume = V.sum()
    first = (V[:, None] * s).sum(0) / 4
    outer = sum(x[:, :, None] * x[:, None, :] for x in (a, b, c, s))
    second = (V[:, None, None] * outer).sum(0) / 20
    centre = first / volume
    return volume, middle + centre, second - volume * centre[:, None] * centre[None, :]


def _closed(given: Any, count: int) -> np.ndarray:
    """Check that every edge occurs equally often in both directions, and return the triangles."""
    try:
        triangles = np.asarray(given)
    except ValueError as error:
        raise InputError("mesh: triangles is ragged, expected (m, 3) integers") from error
    if triangles.ndim != 2 or triangles.shape[1] != 3 or triangles.dtype.kind not in "iu":
        raise InputError(
            f"mesh: triangles has shape {triangles.shape} and dtype {triangles.dtype}, expected "
            f"(m, 3) integers"
        )
    if triangles.min(initial=0) < 0 or triangles.max(initial=0) >= count:
        raise InputError(
            f"mesh: triangles have vertices {triangles.min()} to {triangles.max()}, expected 0 to "
            f"{count - 1}"
        )
    edges = Counter((int(t[i]), int(t[(i + 1) % 3])) for t in triangles for i in range(3))
    for (i, j), times in edges.items():
        if edges[j, i] != times:
            raise InputError(
                f"mesh: the edge from vertex {i} to {j} occurs {times} times in this direction and "
                f"{edges[j, i]} times in the other, expected a closed surface with all triangles "
                f"counter-clockwise seen from outside"
            )
    return triangles
