"""Mass, centre of mass and inertia of a rigid body, as arrays (Featherstone, 2.13; Olguin Diaz, 5).

Spatial inertia about the origin of a frame, with c the centre of mass and I_c about it:

    I = [I_c + m [c][c]^T, m [c]; m [c]^T, m 1]        momentum = I V,   T = V . I V / 2
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.lanes import Mat3, Sym3, Vec3, matmat, matvec
from rbjax.spatial.arguments import entries, pose_parts, stacked, takes
from rbjax.spatial.inertia import ArticulatedInertia, RigidInertia
from rbjax.spatial.transform import Transform
from rbjax.spatial.vectors import Motion


class MassProperties(NamedTuple):
    """mass (...) in kg, com (..., 3) in the frame in m, inertia (..., 3, 3) about com in kg m^2."""

    mass: jax.Array
    com: jax.Array
    inertia: jax.Array


class PrincipalAxes(NamedTuple):
    """I = R diag(moments) R^T, moments ascending, R (..., 3, 3) a rotation.

    `gap` is the smallest difference between two moments, over the largest moment. It is 0 where two
    are equal and the axes in their plane are arbitrary. Derivatives stay finite there: they keep
    the chosen axes.
    """

    moments: jax.Array
    R: jax.Array
    gap: jax.Array


@takes(mass="scalar", com="vector", inertia="matrix")
def spatial_inertia(mass: jax.Array, com: jax.Array, inertia: jax.Array) -> jax.Array:
    """I (..., 6, 6) from mass, centre of mass and the inertia about it.

    >>> spatial_inertia(2.0, [0.0, 0.0, 1.0], jnp.eye(3))[0].tolist()
    [3.0, 0.0, 0.0, 0.0, -2.0, 0.0]
    """
    return _matrix(_rigid(mass, com, inertia))


@takes(matrix="matrix6")
def mass_properties(matrix: jax.Array) -> MassProperties:
    """Mass, centre of mass and the inertia about it, from a spatial inertia (..., 6, 6).

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
def parallel_axes(inertia: jax.Array, mass: jax.Array, offset: jax.Array) -> jax.Array:
    """I + m [d][d]^T (Steiner): I (..., 3, 3) about the centre of mass, moved to a point at d.

    >>> parallel_axes(jnp.eye(3), 2.0, [0.0, 0.0, 1.0]).tolist()
    [[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 1.0]]
    """
    square = (offset * offset).sum(-1)[..., None, None] * jnp.eye(3, dtype=inertia.dtype)
    outer = offset[..., :, None] * offset[..., None, :]
    return inertia + mass[..., None, None] * (square - outer)


@takes(R="rotation", inertia="matrix")
def rotate_inertia(R: jax.Array, inertia: jax.Array) -> jax.Array:
    """R I R^T (..., 3, 3): I_A from I_B and R = R_AB."""
    return stacked(Sym3.upper(Mat3(*entries(inertia, 2))).rotated(Mat3(*entries(R, 2))).dense, 3, 3)


@takes(T="pose", mass="scalar", com="vector", inertia="matrix")
def moved(T: jax.Array, mass: jax.Array, com: jax.Array, inertia: jax.Array) -> MassProperties:
    """The mass properties in A from those in B, with T the pose of B in A:
    `moved(T, *properties)`.
    """
    R, p = pose_parts(T)
    turned = rotate_inertia(T[..., :3, :3], inertia)
    return MassProperties(mass, stacked(p + R @ Vec3(*entries(com))), turned)


@takes(T="pose", matrix="matrix6")
def transform_inertia(T: jax.Array, matrix: jax.Array) -> jax.Array:
    """X* I X^-1 (..., 6, 6): the spatial inertia in A from that in B, with T the pose of B in A.

    I may be any symmetric (6, 6), such as added mass.
    """
    J, H, M = (entries(matrix[..., i : i + 3, j : j + 3], 2) for i, j in ((0, 0), (0, 3), (3, 3)))
    inertia = ArticulatedInertia(Sym3.upper(Mat3(*J)), Mat3(*H), Sym3.upper(Mat3(*M)))
    return _matrix(Transform(*pose_parts(T)).articulated_to_parent(inertia))


@takes(matrix="matrix6", V="twist")
def momentum(matrix: jax.Array, V: jax.Array) -> jax.Array:
    """I V (..., 6): [angular momentum about the origin; linear momentum]."""
    return matvec(matrix, V)


@takes(matrix="matrix6", V="twist")
def kinetic_energy(matrix: jax.Array, V: jax.Array) -> jax.Array:
    """V . I V / 2 (...).

    >>> float(kinetic_energy(spatial_inertia(2.0, [0.0, 0.0, 0.0], jnp.eye(3)), jnp.ones(6)))
    4.5
    """
    return (V * momentum(matrix, V)).sum(-1) / 2


@takes(inertia="matrix")
def principal_axes(inertia: jax.Array) -> PrincipalAxes:
    """Principal moments (..., 3), their axes and the gap between the moments.

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
    """d moments = diag(D), dR = R W, W_ij = D_ij / (w_j - w_i), of D = R^T dS R."""
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
    """The columns I e_k of an inertia on lanes."""
    unit = [[1.0 if i == k else 0.0 for i in range(6)] for k in range(6)]
    columns = [list(inertia(Motion.from_lanes(e))) for e in unit]
    return stacked([columns[j][i] for i in range(6) for j in range(6)], 6, 6)
