"""Mass, centre of mass and inertia of a rigid body, as arrays (Featherstone, 2.13; Olguin Diaz, 5).

Spatial inertia about the origin of a frame, with c the center of mass and I_c the inertia about c:

    I = [I_c + m [c][c]^T, m [c]; m [c]^T, m 1]        momentum = I V,   T = V . I V / 2

A body has given inertial parameters if the mass is positive, and the principal moments are positive
and satisfy the triangle inequality A + B >= C. Both hold if the pseudo-inertia, the second moment
of density in homogeneous coordinates, is positive definite (Wensing, Kim & Slotine 2018):

    P = int rho [x; 1] [x; 1]^T dV = [S, h; h^T, m],   S = tr(I_O)/2 1 - I_O,  h = m c

Such a density exists within an ellipsoid Q = {y: [y; 1] . Q [y; 1] >= 0} if also tr(P Q) >= 0.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.lanes import Mat3, Sym3, Vec3, matmat, matvec
from rbjax.rotations.arguments import checked, entries, pose_parts, stacked, takes
from rbjax.spatial.vectors import ArticulatedInertia, Motion, RigidInertia, Transform


@displayed
class MassProperties(NamedTuple):
    """Mass (...) in kg, com (..., 3) in m, and inertia (..., 3, 3) about the com in kg m^2."""

    mass: jax.Array
    com: jax.Array
    inertia: jax.Array


@displayed
class PrincipalAxes(NamedTuple):
    """Principal moments (..., 3), ascending, and axes R (..., 3, 3): I = R diag(moments) R^T.

    `gap` is the smallest difference between two moments, divided by the largest moment. If it is 0,
    two moments are equal and the axes in their plane are arbitrary. Derivatives are then finite and
    belong to the returned axes.
    """

    moments: jax.Array
    R: jax.Array
    gap: jax.Array


@takes(mass="scalar", com="vector", inertia="matrix")
def spatial_inertia(mass: jax.Array, com: jax.Array, inertia: jax.Array) -> jax.Array:
    """Compute the spatial inertia (..., 6, 6) from mass, center of mass and inertia about it.

    >>> spatial_inertia(2.0, [0.0, 0.0, 1.0], jnp.eye(3))[0].tolist()
    [3.0, 0.0, 0.0, 0.0, -2.0, 0.0]
    """
    return _matrix(_rigid(mass, com, inertia))


@takes(matrix="matrix6")
def mass_properties(matrix: jax.Array) -> MassProperties:
    """Compute mass, center of mass and inertia about it from a spatial inertia (..., 6, 6).

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
    """Compute the inertia I + m [d][d]^T about a point at the offset d from the center of mass.

    >>> parallel_axes(jnp.eye(3), 2.0, [0.0, 0.0, 1.0]).tolist()
    [[3.0, 0.0, 0.0], [0.0, 3.0, 0.0], [0.0, 0.0, 1.0]]
    """
    square = (offset * offset).sum(-1)[..., None, None] * jnp.eye(3, dtype=inertia.dtype)
    outer = offset[..., :, None] * offset[..., None, :]
    return inertia + mass[..., None, None] * (square - outer)


@takes(R="rotation", inertia="matrix")
def rotate_inertia(R: jax.Array, inertia: jax.Array) -> jax.Array:
    """Rotate an inertia (..., 3, 3) from the axes of B to the axes of A: I_A = R_AB I_B R_AB^T."""
    return stacked(Sym3.upper(Mat3(*entries(inertia, 2))).rotated(Mat3(*entries(R, 2))).dense, 3, 3)


@takes(T="pose", mass="scalar", com="vector", inertia="matrix")
def transform_properties(
    T: jax.Array, mass: jax.Array, com: jax.Array, inertia: jax.Array
) -> MassProperties:
    """Transform mass properties from a frame B to a frame A, with T the pose of B in A.

    Call it as `transform_properties(T, *properties)`.
    """
    R, p = pose_parts(T)
    turned = rotate_inertia(T[..., :3, :3], inertia)
    return MassProperties(mass, stacked(p + R @ Vec3(*entries(com))), turned)


@takes(T="pose", matrix="matrix6")
def transform_inertia(T: jax.Array, matrix: jax.Array) -> jax.Array:
    """Transform a spatial inertia from B to A: X* I X^-1 (..., 6, 6), with T the pose of B in A.

    I may be any symmetric (6, 6), such as added mass.
    """
    J, H, M = (entries(matrix[..., i : i + 3, j : j + 3], 2) for i, j in ((0, 0), (0, 3), (3, 3)))
    inertia = ArticulatedInertia(Sym3.upper(Mat3(*J)), Mat3(*H), Sym3.upper(Mat3(*M)))
    return _matrix(Transform(*pose_parts(T)).articulated_to_parent(inertia))


@takes(matrix="matrix6", V="twist")
def momentum(matrix: jax.Array, V: jax.Array) -> jax.Array:
    """Compute the momentum I V (..., 6): [angular momentum about the origin; linear momentum]."""
    return matvec(matrix, V)


@takes(matrix="matrix6", V="twist")
def kinetic_energy(matrix: jax.Array, V: jax.Array) -> jax.Array:
    """Compute the kinetic energy V . I V / 2 (...).

    >>> float(kinetic_energy(spatial_inertia(2.0, [0.0, 0.0, 0.0], jnp.eye(3)), jnp.ones(6)))
    4.5
    """
    return (V * momentum(matrix, V)).sum(-1) / 2


@takes(inertia="matrix")
def principal_axes(inertia: jax.Array) -> PrincipalAxes:
    """Compute the principal moments (..., 3), their axes and the gap between the moments.

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


@displayed
class Consistency(NamedTuple):
    """The conditions for inertial parameters of a body, and their margin.

    A body exists only if mass and principal moments are positive and no moment is larger than the
    sum of the other two. The margin is negative if this fails.
    """

    positive_definite: jax.Array  # mass and principal moments above zero
    triangle: jax.Array  # no principal moment is larger than the sum of the other two
    realizable: jax.Array  # both conditions hold strictly, as for a body with volume
    moments: jax.Array  # principal moments (..., 3), ascending
    triangle_margin: jax.Array  # (A + B - C) / C: 0 for a flat body, 1 at most


@takes(mass="scalar", com="vector", inertia="matrix")
def pseudo_inertia(mass: jax.Array, com: jax.Array, inertia: jax.Array) -> jax.Array:
    """Compute the pseudo-inertia P (..., 4, 4) from mass, center of mass and inertia about it.

    >>> jnp.diag(pseudo_inertia(2.0, [0.0, 0.0, 1.0], jnp.eye(3))).tolist()
    [0.5, 0.5, 2.5, 2.0]
    """
    about = parallel_axes(inertia, mass, com)
    half = jnp.trace(about, axis1=-2, axis2=-1)[..., None, None] / 2
    S = half * jnp.eye(3, dtype=mass.dtype) - about
    h = (mass[..., None] * com)[..., None]
    shape = jnp.broadcast_shapes(S.shape[:-2], h.shape[:-2])
    S, h = jnp.broadcast_to(S, (*shape, 3, 3)), jnp.broadcast_to(h, (*shape, 3, 1))
    m = jnp.broadcast_to(mass[..., None, None], (*shape, 1, 1))
    bottom = jnp.concatenate([jnp.swapaxes(h, -1, -2), m], -1)
    return jnp.concatenate([jnp.concatenate([S, h], -1), bottom], -2)


@takes(P="matrix4")
def from_pseudo_inertia(P: jax.Array) -> MassProperties:
    """Compute mass, center of mass and inertia about it from a pseudo-inertia P (..., 4, 4)."""
    mass, h, S = P[..., 3, 3], P[..., :3, 3], P[..., :3, :3]
    about = jnp.trace(S, axis1=-2, axis2=-1)[..., None, None] * jnp.eye(3, dtype=P.dtype) - S
    com = h / mass[..., None]
    return MassProperties(mass, com, parallel_axes(about, -mass, com))


@takes(mass="scalar", inertia="matrix")
def consistency(mass: jax.Array, inertia: jax.Array) -> Consistency:
    """Evaluate the consistency conditions of a mass (...) and an inertia (..., 3, 3) about the com.

    >>> c = consistency(1.0, jnp.diag(jnp.array([1.0, 1.0, 3.0])))
    >>> bool(c.positive_definite), bool(c.triangle), float(c.triangle_margin.round(6))
    (True, False, -0.333333)
    """
    symmetric = (inertia + jnp.swapaxes(inertia, -1, -2)) / 2
    moments = jnp.linalg.eigvalsh(symmetric)
    A, B, C = moments[..., 0], moments[..., 1], moments[..., 2]
    rounding = 16 * jnp.finfo(moments.dtype).eps
    margin = (A + B - C) / jnp.where(C > 0, C, 1.0)
    definite = (mass > 0) & (A > 0)
    return Consistency(
        definite, margin >= -rounding, definite & (margin > rounding), moments, margin
    )


@takes(
    positive=["mass", "semi_axes"],
    mass="scalar",
    com="vector",
    inertia="matrix",
    semi_axes="vector",
    centre="vector",
)
def ellipsoid_margin(
    mass: jax.Array, com: jax.Array, inertia: jax.Array, semi_axes: jax.Array, centre: jax.Array
) -> jax.Array:
    """Compute tr(P Q) / m (...), which is at least 0 if the mass can be inside an ellipsoid.

    It is 1 if all mass is at the center. The ellipsoid has the given semi-axes (..., 3) along the
    axes of the frame.

    >>> ball = 1.0, [0.0, 0.0, 0.0], 0.4 * jnp.eye(3)
    >>> round(float(ellipsoid_margin(*ball, jnp.ones(3), jnp.zeros(3))), 6)
    0.4
    """
    P = pseudo_inertia(mass, com - centre, inertia)
    second = jnp.diagonal(P[..., :3, :3], axis1=-2, axis2=-1)
    return 1 - (second / semi_axes**2).sum(-1) / mass


def check_mass_properties(mass: jax.Array, com: jax.Array, inertia: jax.Array) -> MassProperties:
    """Check that a body can have these mass properties, and return them.

    It raises `InputError` if not. Flat and thin bodies pass. Traced values are not checked: use
    `consistency` for them.

    >>> check_mass_properties(1.0, [0.0, 0.0, 0.0], jnp.diag(jnp.array([1.0, 1.0, 3.0])))
    Traceback (most recent call last):
    rbjax.errors.InputError: inertia: the principal moments 1, 1, 3 break the triangle ...
    """
    found = consistency(mass, inertia)
    com = checked("check_mass_properties", "com", com, "vector")
    out = MassProperties(jnp.asarray(mass), com, jnp.asarray(inertia))
    if any(isinstance(x, jax.core.Tracer) for x in (*found, *out)):
        return out
    I, m = np.asarray(out.inertia), np.asarray(out.mass)
    if not (m > 0).all():
        raise InputError(f"mass is {m.min():g}, expected more than zero")
    scale = np.abs(I).max(initial=0.0)
    skew = np.abs(I - I.swapaxes(-1, -2)).max(initial=0.0)
    if skew > 1e-6 * scale:
        raise InputError(
            f"inertia: it differs from its transpose by {skew:.2g}, expected a symmetric matrix"
        )
    three = ", ".join(f"{x:.6g}" for x in _worst(found))
    eps = 16 * np.finfo(np.asarray(found.moments).dtype).eps
    if (np.asarray(found.moments)[..., 0] < -eps * scale).any():
        raise InputError(
            f"inertia: the principal moments are {three}, expected none below zero; give the "
            f"inertia about the centre of mass, in kg m^2"
        )
    if not np.asarray(found.triangle).all():
        raise InputError(
            f"inertia: the principal moments {three} break the triangle inequality (the largest is "
            f"at most the sum of the others); give the inertia about the centre of mass"
        )
    return out


def _worst(found: Consistency) -> np.ndarray:
    """Return the moments of the sample with the smallest margin."""
    moments = np.asarray(found.moments).reshape(-1, 3)
    return moments[np.argmin(np.asarray(found.triangle_margin).reshape(-1))]
