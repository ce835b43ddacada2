"""Distances between inertias, the same in every frame and in every unit.

With P, Q pseudo-inertias and lambda the eigenvalues of Q^-1 P:

    log-determinant divergence   d(P||Q) = tr(Q^-1 P) - log det(Q^-1 P) - 4
                                         = sum(lambda - 1 - log lambda)
    affine-invariant distance    sqrt(sum log^2 lambda)
    pull-back metric at Q        |dP|_Q^2 = tr(Q^-1 dP Q^-1 dP),   d(P||Q) ~ |P - Q|_Q^2 / 2

A change of frame or units P -> G P G^T, Q -> G Q G^T keeps the eigenvalues. The divergence is the
entropy of two normal densities with these moments; it grows without bound as P loses definiteness.

With the upper factors P = U U^T, Q = V V^T, B = V^-1 U is upper triangular and

    d(P||Q) = sum over i < j of B_ij^2 + sum over i of (e^(2x) - 1 - 2x),   B_ii = e^x,

a sum of ten squares: a prior that a least-squares method takes as it is (`prior_residual`).
Lee, Wensing & Park, IEEE T-RO 36(3), 2020; Lee & Park, IEEE RA-L 3(2), 2018.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.spatial.arguments import takes
from rbjax.sysid.parameters.log_cholesky import pseudo_inertia_of, to_log_cholesky, upper_factor

_UPPER = np.triu_indices(4, 1)


def log_determinant_divergence(P: jax.Array, Q: jax.Array) -> jax.Array:
    """d(P||Q) (...) of two pseudo-inertias; 0 if they are equal.

        tr(Q^-1 P) - log det(Q^-1 P) - 4

    Args:
        P: (..., 4, 4) positive definite.
        Q: (..., 4, 4) positive definite, such as that of the CAD model.

    Raises:
        InputError: a known matrix is not positive definite.

    Source: Lee, Wensing & Park 2020, eq. 21.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid import log_determinant_divergence
        >>> round(float(log_determinant_divergence(2 * jnp.eye(4), jnp.eye(4))), 4)
        1.2274
    """
    r = prior_residual(to_log_cholesky(P), to_log_cholesky(Q))
    return (r * r).sum(-1)


def affine_invariant_distance(P: jax.Array, Q: jax.Array) -> jax.Array:
    """The geodesic distance (...) of two pseudo-inertias: symmetric, and obeys the triangle rule.

        sqrt(sum log^2 lambda),   lambda the eigenvalues of Q^-1 P

    First derivatives are finite everywhere, second ones where no two eigenvalues are equal.

    Args:
        P, Q: (..., 4, 4) positive definite.

    Raises:
        InputError: a known matrix is not positive definite.

    Source: Lee & Park 2018, eq. 13.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid import affine_invariant_distance
        >>> round(float(affine_invariant_distance(jnp.eye(4), 2 * jnp.eye(4))), 4)
        1.3863
    """
    logs = jnp.log(jnp.linalg.eigvalsh(_relative(P, Q)))
    square = (logs * logs).sum(-1)
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def pullback_distance(P: jax.Array, Q: jax.Array) -> jax.Array:
    """|P - Q| (...) in the metric that is constant and equal to the affine-invariant one at Q.

        |Q^-1/2 (P - Q) Q^-1/2|_F = sqrt(sum (lambda - 1)^2)

    Args:
        P: (..., 4, 4).
        Q: (..., 4, 4) positive definite.

    Source: Lee, Wensing & Park 2020, eq. 26.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid import pullback_distance
        >>> float(pullback_distance(2 * jnp.eye(4), jnp.eye(4)))
        2.0
    """
    relative = _relative(P, Q)
    off = relative - jnp.eye(4, dtype=relative.dtype)
    square = (off * off).sum((-1, -2))
    return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)


def pullback_metric(phi: jax.Array) -> jax.Array:
    """G (..., 10, 10) with |dphi|^2 = dphi . G dphi the pull-back metric at a body.

    So (phi - phi0) . G(phi0) (phi - phi0) / 2 is a prior for linear least squares, equal to the
    divergence to second order.

    Args:
        phi: (..., 10) inertial parameters of a body that can exist.

    Source: Lee, Wensing & Park 2020, eq. 25.

    Example:
        >>> import rbjax as rb
        >>> from rbjax.sysid import pullback_metric
        >>> pullback_metric(rb.inertial_parameters(rb.load("pendulum"))).shape
        (10, 10)
    """
    V = upper_factor(to_log_cholesky(pseudo_inertia_of(phi)))
    inverse = jax.scipy.linalg.solve_triangular(
        V, jnp.broadcast_to(jnp.eye(4, dtype=V.dtype), V.shape)
    )
    each = pseudo_inertia_of(jnp.eye(10, dtype=V.dtype))  # dP of each parameter
    whitened = jnp.einsum("...ij,kjl,...ml->...kim", inverse, each, inverse)
    return jnp.einsum("...kim,...lim->...kl", whitened, whitened)


@takes(theta="inertial", prior="inertial")
def prior_residual(theta: jax.Array, prior: jax.Array) -> jax.Array:
    """Ten numbers r (..., 10) with |r|^2 = d(P(theta)||P(prior)), smooth everywhere.

        r = (B_ij for i < j, sign(x) sqrt(e^(2x) - 1 - 2x)),   B = V^-1 U,  B_ii = e^x

    Args:
        theta: (..., 10) log-Cholesky coordinates.
        prior: (..., 10) those of the CAD model.

    Source: the divergence of Lee, Wensing & Park 2020, in the coordinates of Rucker & Wensing 2022.

    Example:
        >>> import jax.numpy as jnp
        >>> from rbjax.sysid import prior_residual
        >>> prior_residual(jnp.zeros(10), jnp.zeros(10)).tolist()
        [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    """
    theta, prior = jnp.broadcast_arrays(theta, prior)
    B = jax.scipy.linalg.solve_triangular(upper_factor(prior), upper_factor(theta))
    step = theta - prior
    a, d = step[..., 0], step[..., 1:4]
    diagonal = scalar_residual(jnp.concatenate([a[..., None], a[..., None] + d], -1))
    return jnp.concatenate([diagonal, B[..., _UPPER[0], _UPPER[1]]], -1)


def scalar_residual(x: jax.Array) -> jax.Array:
    """r with r^2 = e^(2x) - 1 - 2x, the divergence of one positive number from another, e^(2x) the
    quotient of the two; r ~ sqrt(2) x near 0."""
    y = 2 * x
    small = jnp.abs(y) < 0.05
    far = jnp.where(small, 1.0, y)
    # 2 (e^y - 1 - y) / y^2 and its series, whose last term is below 1e-16 where it is used
    quotient = 2 * (jnp.expm1(far) - far) / far**2
    series = jnp.zeros_like(y)
    for k in range(11, 2, -1):
        series = (1 + series) * y / k
    return x * jnp.sqrt(2 * jnp.where(small, 1 + series, quotient))


def _relative(P: jax.Array, Q: jax.Array) -> jax.Array:
    """V^-1 P V^-T, similar to Q^-1 P."""
    V = upper_factor(to_log_cholesky(Q))
    P = jnp.broadcast_to(jnp.asarray(P, V.dtype), jnp.broadcast_shapes(jnp.shape(P), V.shape))
    V = jnp.broadcast_to(V, P.shape)
    half = jax.scipy.linalg.solve_triangular(V, P)
    return jax.scipy.linalg.solve_triangular(V, jnp.swapaxes(half, -1, -2))
