"""Mass, centre of mass and inertia of a rigid body, as arrays (Featherstone, 2.13; Olguin Diaz, 5).

Spatial inertia about the origin of a frame, with c the center of mass and I_c the inertia about c:

    I = [I_c + m [c][c]^T, m [c]; m [c]^T, m 1]        momentum = I V,   T = V . I V / 2
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.arguments import ArrayLike
from rbjax.display import displayed
from rbjax.lanes import Mat3, Sym3, Vec3, matmat, matvec
from rbjax.rotations.arguments import entries, pose_parts, stacked, takes
from rbjax.spatial.vectors import ArticulatedInertia, Motion, RigidInertia, Transform


@displayed
class MassProperties(NamedTuple):
    """The mass, the centre of mass and the inertia of a body.

    Fields:
        mass: (...), kg.
        com: (..., 3), m.
        inertia: (..., 3, 3), about the centre of mass, kg m^2.
    """

    mass: jax.Array
    com: jax.Array
    inertia: jax.Array


@displayed
class PrincipalAxes(NamedTuple):
    """Principal moments and axes: I = R diag(moments) R^T.

    If the gap is 0, two moments are equal and the axes in their plane are arbitrary. Derivatives
    are then finite and belong to the returned axes.

    Fields:
        moments: (..., 3), ascending, kg m^2.
        R: (..., 3, 3), the axes as columns, no unit.
        gap: (...), smallest difference between two moments, relative to the largest moment.
    """

    moments: jax.Array
    R: jax.Array
    gap: jax.Array


@takes(mass="scalar", com="vector", inertia="matrix")
def spatial_inertia(mass: ArrayLike, com: ArrayLike, inertia: ArrayLike) -> jax.Array:
    """Compute the spatial inertia (..., 6, 6) from mass, center of mass and inertia about it.

    Args:
        mass: (...), kg.
        com: (..., 3), centre of mass, m.
        inertia: (..., 3, 3), about the centre of mass, kg m^2.

    Returns:
        (..., 6, 6), about the origin: kg m^2, kg m and kg.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import spatial_inertia
        >>> spatial_inertia(2.0, [0.0, 0.0, 1.0], jnp.eye(3))[0].tolist()
        [3.0, 0.0, 0.0, 0.0, -2.0, 0.0]
    """
    return _matrix(_rigid(mass, com, inertia))


@takes(matrix="matrix6")
def mass_properties(matrix: ArrayLike) -> MassProperties:
    """Compute mass, center of mass and inertia about it from a spatial inertia (..., 6, 6).

    Args:
        matrix: (..., 6, 6), spatial inertia about the origin: kg m^2, kg m and kg.

    Returns:
        `MassProperties`.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import mass_properties, spatial_inertia
        >>> m = mass_properties(spatial_inertia(2.0, [0.0, 0.0, 1.0], jnp.eye(3)))
        >>> float(m.mass), m.com.tolist(), m.inertia[0].tolist()
        (2.0, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0])
    """
    mass = jnp.trace(matrix[..., 3:, 3:], axis1=-2, axis2=-1) / 3
    h = matrix[..., :3, 3:]
    skew = (h[..., (2, 0, 1), (1, 2, 0)] - h[..., (1, 2, 0), (2, 0, 1)]) / 2
    com = skew / mass[..., None]
    return MassProperties(mass, com, parallel_axes(matrix[..., :3, :3], -mass, com))


@takes(inertia="matrix", mass="scalar", offset="vector")
def parallel_axes(inertia: ArrayLike, mass: ArrayLike, offset: ArrayLike) -> jax.Array:
    """Compute the inertia I + m [d][d]^T about a point at the offset d from the center of mass.

    Args:
        inertia: (..., 3, 3), about the centre of mass, kg m^2.
        mass: (...), kg.
        offset: (..., 3), from the centre of mass, m.

    Returns:
        (..., 3, 3), kg m^2.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import parallel_axes
        >>> parallel_axes(jnp.eye(3), 2.0, [0.0, 0.0, 1.0]).tolist()
        [[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 1.0]]
    """
    square = (offset * offset).sum(-1)[..., None, None] * jnp.eye(3, dtype=inertia.dtype)
    outer = offset[..., :, None] * offset[..., None, :]
    return inertia + mass[..., None, None] * (square - outer)


@takes(R="rotation", inertia="matrix")
def rotate_inertia(R: ArrayLike, inertia: ArrayLike) -> jax.Array:
    """Rotate an inertia (..., 3, 3) from the axes of B to the axes of A: I_A = R_AB I_B R_AB^T.

    Args:
        R: (..., 3, 3), R_AB, no unit.
        inertia: (..., 3, 3), in the axes of B, kg m^2.

    Returns:
        (..., 3, 3), kg m^2.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not rotations.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import rotate_inertia
        >>> R = [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]
        >>> rotate_inertia(R, jnp.diag(jnp.array([1.0, 2.0, 3.0]))).diagonal().tolist()
        [2.0, 1.0, 3.0]
    """
    return stacked(Sym3.upper(Mat3(*entries(inertia, 2))).rotated(Mat3(*entries(R, 2))).dense, 3, 3)


@takes(T="pose", mass="scalar", com="vector", inertia="matrix")
def transform_properties(
    T: ArrayLike, mass: ArrayLike, com: ArrayLike, inertia: ArrayLike
) -> MassProperties:
    """Transform mass properties from a frame B to a frame A, with T the pose of B in A.

    Call it as `transform_properties(T, *properties)`.

    Args:
        T: (..., 4, 4), pose of B in A, with lengths in m.
        mass: (...), kg.
        com: (..., 3), centre of mass, m.
        inertia: (..., 3, 3), about the centre of mass, kg m^2.

    Returns:
        `MassProperties` in A.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import transform_properties
        >>> T = jnp.eye(4).at[0, 3].set(2.0)
        >>> transform_properties(T, 1.0, [1.0, 0.0, 0.0], jnp.eye(3)).com.tolist()
        [3.0, 0.0, 0.0]
    """
    R, p = pose_parts(T)
    turned = rotate_inertia(T[..., :3, :3], inertia)
    return MassProperties(mass, stacked(p + R @ Vec3(*entries(com))), turned)


@takes(T="pose", matrix="matrix6")
def transform_inertia(T: ArrayLike, matrix: ArrayLike) -> jax.Array:
    """Transform a spatial inertia from B to A: X* I X^-1 (..., 6, 6), with T the pose of B in A.

    I may be any symmetric (6, 6), such as added mass.

    Args:
        T: (..., 4, 4), pose of B in A, with lengths in m.
        matrix: (..., 6, 6), spatial inertia about the origin: kg m^2, kg m and kg.

    Returns:
        (..., 6, 6), in A: kg m^2, kg m and kg.

    Raises:
        InputError: another shape, values that are not finite, or matrices that are not poses.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import transform_inertia
        >>> T = jnp.eye(4).at[0, 3].set(2.0)
        >>> transform_inertia(T, jnp.eye(6)).diagonal().tolist()
        [1.0, 5.0, 5.0, 1.0, 1.0, 1.0]
    """
    J, H, M = (entries(matrix[..., i : i + 3, j : j + 3], 2) for i, j in ((0, 0), (0, 3), (3, 3)))
    inertia = ArticulatedInertia(Sym3.upper(Mat3(*J)), Mat3(*H), Sym3.upper(Mat3(*M)))
    return _matrix(Transform(*pose_parts(T)).articulated_to_parent(inertia))


@takes(matrix="matrix6", V="twist")
def momentum(matrix: ArrayLike, V: ArrayLike) -> jax.Array:
    """Compute the momentum I V (..., 6): [angular momentum about the origin; linear momentum].

    Args:
        matrix: (..., 6, 6), spatial inertia about the origin: kg m^2, kg m and kg.
        V: (..., 6), twists, rad/s, then m/s.

    Returns:
        (..., 6), N m s, then N s.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import momentum
        >>> momentum(2 * jnp.eye(6), jnp.ones(6)).tolist()
        [2.0, 2.0, 2.0, 2.0, 2.0, 2.0]
    """
    return matvec(matrix, V)


@takes(matrix="matrix6", V="twist")
def kinetic_energy(matrix: ArrayLike, V: ArrayLike) -> jax.Array:
    """Compute the kinetic energy V . I V / 2 (...).

    Args:
        matrix: (..., 6, 6), spatial inertia about the origin: kg m^2, kg m and kg.
        V: (..., 6), twists, rad/s, then m/s.

    Returns:
        (...), J.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import kinetic_energy, spatial_inertia
        >>> float(kinetic_energy(spatial_inertia(2.0, [0.0, 0.0, 0.0], jnp.eye(3)), jnp.ones(6)))
        4.5
    """
    return (V * momentum(matrix, V)).sum(-1) / 2


@takes(inertia="matrix")
def principal_axes(inertia: ArrayLike) -> PrincipalAxes:
    """Compute the principal moments (..., 3), their axes and the gap between the moments.

    Args:
        inertia: (..., 3, 3), about the centre of mass, kg m^2.

    Returns:
        `PrincipalAxes`.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> from rbjax.spatial import principal_axes
        >>> axes = principal_axes([[3.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 2.0]])
        >>> axes.moments.round(6).tolist(), float(axes.gap.round(6))
        ([1.0, 2.0, 3.0], 0.333333)
    """
    moments, R = _eigen(inertia)
    least = jnp.minimum(moments[..., 1] - moments[..., 0], moments[..., 2] - moments[..., 1])
    largest = jnp.maximum(jnp.abs(moments[..., 2]), jnp.abs(moments[..., 0]))
    return PrincipalAxes(moments, R, least / jnp.where(largest > 0, largest, 1.0))


@jax.custom_jvp
def _eigen(S: jax.Array) -> tuple[jax.Array, jax.Array]:
    w, V = jnp.linalg.eigh(S)
    a, b, c = Mat3(*entries(V, 2)).columns
    return w, V * jnp.where(a.dot(b.cross(c)) < 0, -1.0, 1.0)[..., None, None]


@_eigen.defjvp
def _eigen_jvp(primals: Any, tangents: Any) -> Any:
    """Compute the derivative of eigenvalues w and eigenvectors R of a symmetric S. dw = diag(D) and
    dR = R W, with D = R^T dS R and W_ij = D_ij / (w_j - w_i) if w_i and w_j differ."""
    (S,), (dS,) = primals, tangents
    w, R = _eigen(S)
    Rt = jnp.swapaxes(R, -1, -2)
    D = matmat(matmat(Rt, (dS + jnp.swapaxes(dS, -1, -2)) / 2), R)
    apart = w[..., None, :] - w[..., :, None]
    scale = jnp.abs(w).max(-1)[..., None, None] * 8 * jnp.finfo(w.dtype).eps
    distinct = jnp.abs(apart) > scale
    W = jnp.where(distinct, D / jnp.where(distinct, apart, 1.0), 0.0)
    return (w, R), (jnp.diagonal(D, axis1=-2, axis2=-1), matmat(R, W))


def _rigid(mass: jax.Array, com: jax.Array, inertia: jax.Array) -> RigidInertia:
    J = Sym3.upper(Mat3(*entries(inertia, 2)))
    return RigidInertia(mass, Vec3.zero(), J).shifted(Vec3(*entries(com)))


def _matrix(inertia: Any) -> jax.Array:
    """Convert an inertia on lanes to a matrix (..., 6, 6)."""
    unit = [[1.0 if i == k else 0.0 for i in range(6)] for k in range(6)]
    columns = [list(inertia(Motion.from_lanes(e))) for e in unit]
    return stacked([columns[j][i] for i in range(6) for j in range(6)], 6, 6)
