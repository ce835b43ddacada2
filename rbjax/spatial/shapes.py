"""Mass, centre of mass and inertia of solids, from their dimensions and density or mass.

Lengths are in m. A shape is at the origin with its axis along z. Use `transform_properties` to move
it. Density is in kg/m^3 (kg/m^2 for a plate, kg/m for a rod). Dimensions may be batches, and all
results are differentiable in them. `combine` joins bodies, and `hole` makes one of them empty:

    combine([box([1.0, 1.0, 1.0], density=700.0), hole(sphere(0.2, density=700.0))])
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import check_positive, instance
from rbjax.errors import InputError
from rbjax.rotations.arguments import checked, entries, stacked, takes
from rbjax.spatial.mass import MassProperties, parallel_axes
from rbjax.spatial.mesh_shapes import check_one_of, mesh, points

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

    Args:
        size: (..., 3), edges, m.
        density: kg/m^3; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, or both or neither of density and mass.

    Example:
        >>> from rbjax.spatial.shapes import box
        >>> box([1.0, 2.0, 3.0], density=2.0).inertia.diagonal().tolist()
        [13.0, 10.0, 5.0]
    """
    a, b, c = entries(size)
    xx, yy, zz = a * a / 12, b * b / 12, c * c / 12
    return _body(a * b * c, [0.0, 0.0, 0.0], [yy + zz, xx + zz, xx + yy], density, mass)


@_solid(semi_axes="vector")
def ellipsoid(semi_axes: jax.Array, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    """Compute the mass properties of an ellipsoid with semi-axes (..., 3) about its center.

    Args:
        semi_axes: (..., 3), m.
        density: kg/m^3; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, or both or neither of density and mass.

    Example:
        >>> from rbjax.spatial.shapes import ellipsoid
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

    Args:
        radius: (...), m.
        density: kg/m^3; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, or both or neither of density and mass.

    Example:
        >>> from rbjax.spatial.shapes import sphere
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

    Args:
        radius: (...), m.
        length: (...), m.
        density: kg/m^3; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, or both or neither of density and mass.

    Example:
        >>> from rbjax.spatial.shapes import cylinder
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

    Args:
        outer: (...), outer radius, m.
        inner: (...), inner radius, m.
        length: (...), m.
        density: kg/m^3; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, an inner radius that is not below the outer one,
            or both or neither of density and mass.

    Example:
        >>> from rbjax.spatial.shapes import tube
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

    Args:
        radius: (...), m.
        length: (...), m.
        density: kg/m^3; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, or both or neither of density and mass.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial.shapes import capsule
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

    Args:
        radius: (...), m.
        height: (...), m.
        density: kg/m^3; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, or both or neither of density and mass.

    Example:
        >>> from rbjax.spatial.shapes import cone
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

    Args:
        length: (...), m.
        density: kg/m; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, or both or neither of density and mass.

    Example:
        >>> from rbjax.spatial.shapes import rod
        >>> rod(2.0, mass=3.0).inertia.diagonal().tolist()
        [1.0, 1.0, 0.0]
    """
    I = length * length / 12
    return _body(length, [0.0, 0.0, 0.0], [I, I, jnp.zeros_like(I)], density, mass)


@_solid(size="pair")
def plate(size: jax.Array, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    """Compute the mass properties of a thin plate about its center; density in kg/m^2.

    `size` (..., 2) is the edges along x and y.

    Args:
        size: (..., 2), edges along x and y, m.
        density: kg/m^2; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a size that is not above zero, or both or neither of density and mass.

    Example:
        >>> from rbjax.spatial.shapes import plate
        >>> plate([2.0, 4.0], mass=3.0).inertia.diagonal().tolist()
        [4.0, 1.0, 5.0]
    """
    a, b = entries(size)
    xx, yy = a * a / 12, b * b / 12
    return _body(a * b, [0.0, 0.0, 0.0], [yy, xx, xx + yy], density, mass)


def combine(parts: Sequence[MassProperties]) -> MassProperties:
    """Join the mass properties of bodies, which may be holes, in one common frame.

    Args:
        parts: sequence of `MassProperties` in one frame.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: not a sequence of `MassProperties`, or an empty one.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial.shapes import MassProperties, combine
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
    """Return a part with negative mass and inertia, which `combine` subtracts.

    Args:
        part: `MassProperties` of what fills the hole.

    Returns:
        `MassProperties` with negative mass and inertia, kg and kg m^2.

    Raises:
        InputError: not `MassProperties`.

    Example:
        >>> from rbjax.spatial.shapes import hole, sphere
        >>> float(hole(sphere(1.0, mass=5.0)).mass)
        -5.0
    """
    instance("hole", "part", part, MassProperties, "MassProperties")
    return MassProperties(-part.mass, part.com, -part.inertia)


@takes(outer="scalar", inner="scalar", length="scalar", density="scalar", mass="scalar")
def _bored(outer, inner, length, *, density: Maybe = None, mass: Maybe = None) -> MassProperties:
    return _tube(outer, inner, length, density, mass)


def _tube(outer, inner, length, density: Maybe, mass: Maybe) -> MassProperties:
    square = outer * outer + inner * inner
    volume = jnp.pi * (outer - inner) * (outer + inner) * length
    across = square / 4 + length * length / 12
    return _body(volume, [0.0, 0.0, 0.0], [across, across, square / 2], density, mass)


def _body(volume, com: list, moments: list, density: Maybe, mass: Maybe) -> MassProperties:
    """Compute mass properties from volume (area, length), center of mass and principal moments. The
    moments are about the center of mass, for unit mass."""
    check_one_of("", density, mass)
    if mass is not None:
        total = jnp.broadcast_to(mass, jnp.broadcast_shapes(mass.shape, volume.shape))
    else:
        total = density * volume
    a, b, c = (total * x for x in moments)
    where = [jnp.broadcast_to(jnp.asarray(x, total.dtype), total.shape) for x in com]
    return MassProperties(total, stacked(where), stacked([a, 0, 0, 0, b, 0, 0, 0, c], 3, 3))
