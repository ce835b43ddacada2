"""Conditions for the inertial parameters of a body, and the pseudo-inertia.

A body has given inertial parameters if the mass is positive, and the principal moments are positive
and satisfy the triangle inequality A + B >= C. Both hold if the pseudo-inertia, the second moment
of density in homogeneous coordinates, is positive definite (Wensing, Kim & Slotine 2018):

    P = int rho [x; 1] [x; 1]^T dV = [S, h; h^T, m],   S = tr(I_O)/2 1 - I_O,  h = m c

Such a density exists within an ellipsoid Q = {y: [y; 1] . Q [y; 1] >= 0} if also tr(P Q) >= 0.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import ArrayLike, check_positive
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.rotations.arguments import checked, takes
from rbjax.spatial.mass import MassProperties, parallel_axes


@displayed
class Consistency(NamedTuple):
    """The conditions for inertial parameters of a body, and their margin.

    A body exists only if mass and principal moments are positive and no moment is larger than the
    sum of the other two. The margin is negative if this fails.

    Fields:
        positive_definite: (...), whether mass and principal moments are above zero.
        triangle: (...), whether no principal moment is larger than the sum of the other two.
        realizable: (...), whether both conditions hold strictly, as for a body with volume.
        moments: (..., 3), principal moments, ascending, kg m^2.
        triangle_margin: (...), (A + B - C) / C: 0 for a flat body, 1 at most.
    """

    positive_definite: jax.Array
    triangle: jax.Array
    realizable: jax.Array
    moments: jax.Array
    triangle_margin: jax.Array


@takes(mass="scalar", com="vector", inertia="matrix")
def pseudo_inertia(mass: ArrayLike, com: ArrayLike, inertia: ArrayLike) -> jax.Array:
    """Compute the pseudo-inertia P (..., 4, 4) from mass, center of mass and inertia about it.

    Args:
        mass: (...), kg.
        com: (..., 3), centre of mass, m.
        inertia: (..., 3, 3), about the centre of mass, kg m^2.

    Returns:
        (..., 4, 4), kg m^2, kg m and kg.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import pseudo_inertia
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
def from_pseudo_inertia(P: ArrayLike) -> MassProperties:
    """Compute mass, center of mass and inertia about it from a pseudo-inertia P (..., 4, 4).

    Args:
        P: (..., 4, 4), kg m^2, kg m and kg.

    Returns:
        `MassProperties`.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import from_pseudo_inertia, pseudo_inertia
        >>> P = pseudo_inertia(2.0, [0.0, 0.0, 1.0], jnp.eye(3))
        >>> from_pseudo_inertia(P).com.tolist()
        [0.0, 0.0, 1.0]
    """
    mass, h, S = P[..., 3, 3], P[..., :3, 3], P[..., :3, :3]
    about = jnp.trace(S, axis1=-2, axis2=-1)[..., None, None] * jnp.eye(3, dtype=P.dtype) - S
    com = h / mass[..., None]
    return MassProperties(mass, com, parallel_axes(about, -mass, com))


@takes(mass="scalar", inertia="matrix")
def consistency(mass: ArrayLike, inertia: ArrayLike) -> Consistency:
    """Evaluate the consistency conditions of a mass (...) and an inertia (..., 3, 3) about the com.

    Args:
        mass: (...), kg.
        inertia: (..., 3, 3), about the centre of mass, kg m^2.

    Returns:
        `Consistency`.

    Raises:
        InputError: another shape, or values that are not finite.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import consistency
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
    mass: ArrayLike, com: ArrayLike, inertia: ArrayLike, semi_axes: ArrayLike, centre: ArrayLike
) -> jax.Array:
    """Compute tr(P Q) / m (...), which is at least 0 if the mass can be inside an ellipsoid.

    It is 1 if all mass is at the center. The ellipsoid has the given semi-axes (..., 3) along the
    axes of the frame.

    Args:
        mass: (...), kg.
        com: (..., 3), centre of mass, m.
        inertia: (..., 3, 3), about the centre of mass, kg m^2.
        semi_axes: (..., 3), of the ellipsoid, m; above zero.
        centre: (..., 3), of the ellipsoid, m.

    Returns:
        (...), no unit.

    Raises:
        InputError: another shape, values that are not finite, or a mass or semi-axis that is not
            above zero.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import ellipsoid_margin
        >>> ball = 1.0, [0.0, 0.0, 0.0], 0.4 * jnp.eye(3)
        >>> round(float(ellipsoid_margin(*ball, jnp.ones(3), jnp.zeros(3))), 6)
        0.4
    """
    P = pseudo_inertia(mass, com - centre, inertia)
    second = jnp.diagonal(P[..., :3, :3], axis1=-2, axis2=-1)
    return 1 - (second / semi_axes**2).sum(-1) / mass


def check_mass_properties(mass: ArrayLike, com: ArrayLike, inertia: ArrayLike) -> MassProperties:
    """Check that a body can have these mass properties, and return them.

    Flat and thin bodies pass. Traced values are not checked: use `consistency` for them.

    Args:
        mass: (...), kg.
        com: (..., 3), centre of mass, m.
        inertia: (..., 3, 3), about the centre of mass, kg m^2.

    Returns:
        `MassProperties` of arrays.

    Raises:
        InputError: a mass that is not positive, or an inertia that no body has.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.spatial import check_mass_properties
        >>> I = jnp.diag(jnp.array([1.0, 1.0, 2.0]))
        >>> float(check_mass_properties(1.0, [0.0, 0.0, 0.0], I).mass)
        1.0
    """
    found = consistency(mass, inertia)
    com = checked("check_mass_properties", "com", com, "vector")
    out = MassProperties(jnp.asarray(mass), com, jnp.asarray(inertia))
    if any(isinstance(x, jax.core.Tracer) for x in (*found, *out)):
        return out
    I, m = np.asarray(out.inertia), np.asarray(out.mass)
    check_positive("check_mass_properties", mass=m)
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
