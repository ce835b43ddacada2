"""The divergence of two inertias, the same in every frame and in every unit.

With P, Q pseudo-inertias and lambda the eigenvalues of Q^-1 P:

    log-determinant divergence   d(P||Q) = tr(Q^-1 P) - log det(Q^-1 P) - 4
                                         = sum(lambda - 1 - log lambda)

A change of frame or units P -> G P G^T, Q -> G Q G^T keeps the eigenvalues. The divergence is the
entropy of two normal densities with these moments; it grows without bound as P loses definiteness.

With the upper factors P = U U^T, Q = V V^T, B = V^-1 U is upper triangular and

    d(P||Q) = sum over i < j of B_ij^2 + sum over i of (e^(2x) - 1 - 2x),   B_ii = e^x,

a sum of ten squares, which a least-squares method takes as prior residuals (`prior_residual`).

Source: Lee, Wensing & Park, IEEE T-RO 36(3), 2020.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.rotations.arguments import takes
from rbjax.sysid.parameters.log_cholesky import to_log_cholesky, upper_factor

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
        >>> from rbjax.sysid.parameters import log_determinant_divergence
        >>> round(float(log_determinant_divergence(2 * jnp.eye(4), jnp.eye(4))), 4)
        1.2274
    """
    r = prior_residual(to_log_cholesky(P), to_log_cholesky(Q))
    return (r * r).sum(-1)


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
        >>> from rbjax.sysid.parameters import prior_residual
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
