"""Added mass: the inertia of the fluid that a body pushes aside (Lamb, ch. 6).

The kinetic energy of an unbounded ideal fluid around a moving body with twist V is V . A V / 2,
with A (6, 6) symmetric. A is the matrix for `Body.added_mass`. Every formulation includes it.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.spatial.arguments import positive, takes

NODES, WEIGHTS = np.polynomial.legendre.leggauss(48)


@positive("semi_axes", "density")
@takes(semi_axes="vector", density="scalar")
def ellipsoid_added_mass(semi_axes: jax.Array, density: jax.Array) -> jax.Array:
    """A (..., 6, 6) of an ellipsoid with these semi-axes about its centre (Lamb, 114-115, 121a).

        alpha_i = abc int_0^inf dl / ((a_i^2 + l) D),    D^2 = prod (a_j^2 + l)

    gives m alpha / (2 - alpha) along the axes, with m the mass of the displaced fluid. A ball has
    m / 2. Digits are lost if the axes differ by a factor of tens.

    >>> ellipsoid_added_mass([1.0, 1.0, 1.0], 3 / (2 * jnp.pi)).diagonal().round(5).tolist()
    [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
    """
    a2, product = semi_axes * semi_axes, jnp.prod(semi_axes, axis=-1)
    # l = s^2 tan^2 u with the mean radius s: smooth for u in (0, pi/2)
    u = jnp.asarray((NODES + 1) * np.pi / 4, a2.dtype)
    weights = jnp.asarray(WEIGHTS * np.pi / 4, a2.dtype)
    s2 = product[..., None] ** (2 / 3)
    l = s2 * jnp.tan(u) ** 2
    dl = 2 * s2 * jnp.tan(u) * (1 + jnp.tan(u) ** 2) * weights
    apart = a2[..., :, None] + l[..., None, :]
    D = jnp.sqrt(jnp.prod(apart, axis=-2))
    alpha = product[..., None] * (dl[..., None, :] / (apart * D[..., None, :])).sum(-1)
    m = (4 / 3 * jnp.pi * density * product)[..., None]
    j, k = np.array([1, 2, 0]), np.array([2, 0, 1])
    less, more = a2[..., j] - a2[..., k], a2[..., j] + a2[..., k]
    turn = alpha[..., k] - alpha[..., j]
    round_ = jnp.abs(less) <= 1e-6 * more  # rotation about such an axis leaves the fluid at rest
    below = jnp.where(round_, 1.0, 2 * less - more * turn)
    angular = jnp.where(round_, 0.0, m / 5 * less**2 * turn / below)
    both = jnp.concatenate([angular, m * alpha / (2 - alpha)], -1)
    return both[..., None] * jnp.eye(6, dtype=a2.dtype)
