"""Random elastic bodies made of points, and their kinetic energy as a sum over points."""

import jax
import jax.numpy as jnp
import numpy as np


def random_points(rng: np.random.Generator, n: int = 40, m: int = 3) -> dict:
    """Masses, places, modes, rotation modes and inertias of n points with m modes."""
    L = rng.normal(size=(n, 3, 3))
    return dict(
        masses=rng.uniform(0.5, 2.0, n),
        places=rng.normal(size=(n, 3)),
        modes=0.3 * rng.normal(size=(n, 3, m)),
        rotation_modes=0.3 * rng.normal(size=(n, 3, m)),
        inertias=0.1 * L @ L.transpose(0, 2, 1),
    )


def energy(points: dict, w: jax.Array, v: jax.Array, q: jax.Array, qd: jax.Array) -> jax.Array:
    """Kinetic energy of points whose inertias keep their axes."""
    m, f, U, V, J = (jnp.asarray(x) for x in points.values())
    velocity = v + jnp.cross(w, f + U @ q) + U @ qd
    turn = w + V @ qd
    return (m * (velocity**2).sum(-1)).sum() / 2 + jnp.einsum("na,nab,nb", turn, J, turn) / 2


def lagrange(T, w, v, q, qd, dw, a, qdd):
    """Wrench and generalized forces of T(w, v, q, qd) by derivatives in body axes.

    d/dt dT/dw + w x dT/dw + v x dT/dv,  d/dt dT/dv + w x dT/dv,  d/dt dT/dqd - dT/dq, for a
    classical acceleration a of the origin: v' = a - w x v.
    """
    dv = a - jnp.cross(w, v)

    def momenta(w, v, q, qd):
        return jax.grad(T, (0, 1, 3))(w, v, q, qd)

    (n, p, _), (dn, dp, dr) = jax.jvp(momenta, (w, v, q, qd), (dw, dv, qd, qdd))
    slope = jax.grad(T, 2)(w, v, q, qd)
    return dn + jnp.cross(w, n) + jnp.cross(v, p), dp + jnp.cross(w, p), dr - slope
