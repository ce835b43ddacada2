"""Mass properties of closed triangle meshes and of particles. They are public in `shapes`.

The integrals over a closed triangle mesh are sums over signed tetrahedra, each spanned by a
triangle and one common point (Mirtich, 1996). For a tetrahedron (0, a, b, c) with volume
V = a . (b x c) / 6 and s = a + b + c

    int x dV = V s / 4,    int x x^T dV = V (a a^T + b b^T + c c^T + s s^T) / 20
"""

from __future__ import annotations

from collections import Counter
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import check_positive
from rbjax.errors import InputError
from rbjax.rotations.arguments import checked, takes
from rbjax.spatial.mass import MassProperties


def check_one_of(where: str, density: Any, mass: Any) -> None:
    if (density is None) == (mass is None):
        both = "neither" if mass is None else "both"
        raise InputError(f"{where}got {both} of density and mass, expected exactly one")


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
        triangles: (m, 3), vertex indices, counter-clockwise seen from outside.
        density: kg/m^3; give it or the mass.
        mass: kg; give it or the density.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: a surface that is open or inside out.

    Example:
        >>> from rbjax.spatial.shapes import mesh
        >>> corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
        >>> solid = mesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], density=6.0)
        >>> round(float(solid.mass), 6), solid.com.round(6).tolist()
        (1.0, [0.25, 0.25, 0.25])
    """
    check_positive("mesh", density=density, mass=mass)
    check_one_of("mesh: ", density, mass)
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

    Args:
        positions: (n, 3), m.
        masses: (n,), kg.

    Returns:
        `MassProperties`, SI units.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial.shapes import points
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
