"""The six base parameters of a planar arm of two joints with gravity, in closed form: torques are
linear in p = (I1 + m2 l1^2, I2, m2 c2x, m2 c2y, m1 c1x + m2 l1, m1 c1y); l1 = 1 m."""

import jax
import jax.numpy as jnp

G = 9.81


def regressor(q: jax.Array, v: jax.Array, a: jax.Array) -> jax.Array:
    """(2 samples, 6) from (samples, 2): rows of joint 1 and joint 2 by turns. Source: the field
    two_R_in_closed_form of the oracle file excitation.json."""
    (q1, q2), (v1, v2), (a1, a2) = q.T, v.T, a.T
    c, s, c12, s12 = jnp.cos(q2), jnp.sin(q2), jnp.cos(q1 + q2), jnp.sin(q1 + q2)
    rate, zero = 2 * v1 * v2 + v2**2, jnp.zeros_like(a1)
    row1 = [
        a1, a1 + a2, c * (2 * a1 + a2) - s * rate + G * c12,
        -s * (2 * a1 + a2) - c * rate - G * s12, G * jnp.cos(q1), -G * jnp.sin(q1),
    ]  # fmt: skip
    row2 = [zero, a1 + a2, c * a1 + s * v1**2 + G * c12, -s * a1 + c * v1**2 - G * s12, zero, zero]
    return jnp.stack([jnp.stack(row1, -1), jnp.stack(row2, -1)], 1).reshape(-1, 6)
