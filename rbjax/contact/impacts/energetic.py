"""Impact of one contact with friction and energetic restitution, integrated in its normal impulse.

With the normal impulse s as independent variable, Coulomb's law holds at every s:

    du/ds = D [1; f],   f = -mu u_t / |u_t| while slipping,   dW/ds = u_n
Slip that stops either sticks, f = -D_tt^-1 D_tn if |f| <= mu, or begins again in the direction d
with D_tn - mu D_tt d = c d, c > 0. Compression ends at u_n = 0 with work W_c < 0. Restitution ends
when the work done on it is -e^2 W_c. So the energy never grows.

Source: Stronge, *Impact Mechanics*, ch. 3-4; Keller, *Impact with friction*, 1986; Kane & Levinson,
*Dynamics*, 1985, 5.8 (the double pendulum, on which Newton's restitution creates energy).
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.lanes.arrays import matvec
from rbjax.solvers.events import carry_back, integrate_until

#: phases of an impact: slip, stick and slip again, each in compression and restitution
PHASES = 6


def energetic_impulse(
    D: jax.Array, u: jax.Array, e: jax.Array, mu: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the impulse (3,) and whether the impact ended.

    Args:
        D: (3, 3) Delassus matrix of the contact, [normal, tangents].
        u: (3,) relative velocity before the impact, u[0] < 0.
        e: energetic restitution, 0 to 1.
        mu: friction, finite.
    """
    speed = jnp.sqrt((jax.lax.stop_gradient(u) ** 2).sum())
    still = 1e-9 * speed if u.dtype == jnp.float64 else 1e-5 * speed
    longest = 1e3 * speed / jnp.abs(jax.lax.stop_gradient(D[0, 0]))
    # a contact point that cannot move in one tangential direction has a singular block
    inverse = jnp.linalg.pinv(D[1:, 1:], rtol=jnp.sqrt(jnp.finfo(u.dtype).eps), hermitian=True)
    stick = -matvec(inverse, D[1:, 0])
    sticks = (stick * stick).sum() <= mu * mu
    again = _slip_direction(D, mu)

    def rate(s: Any, y: jax.Array, args: tuple) -> jax.Array:
        D, mu, stick, slides, _, _ = args
        ut = y[1:3]
        length = jnp.sqrt((ut * ut).sum() + jnp.where(slides, 0, 1))
        f = jnp.where(slides, -mu * ut / length, stick)
        du = D[:, 0] + matvec(D[:, 1:], f)
        return jnp.concatenate([du, y[:1], f])

    def guard(s: Any, y: jax.Array, args: tuple) -> jax.Array:
        _, _, _, slides, restores, left = args
        stage = jnp.where(restores, left - y[3], -y[0])
        slip = jnp.sqrt((y[1:3] ** 2).sum() + jnp.where(slides, 0, 1)) - still
        return jnp.where(slides, jnp.minimum(stage, slip), stage)

    def phase(now: tuple, _: Any) -> tuple[tuple, None]:
        s, y, slides, restores, left, done, fine = now
        args = (D, mu, stick, slides, restores, left)
        end = integrate_until(rate, y, guard, s + longest, args, t0=s, leaving=False)
        stage = jnp.where(restores, left - end.y[3], -end.y[0])
        ended = ~slides | (stage <= jnp.sqrt((end.y[1:3] ** 2).sum()) - still)
        stopped = slides & ~ended
        after = end.y
        # compression ends: the work to restore is e^2 of the work of compression
        starts = ended & ~restores
        new_left = jnp.where(starts, after[3] * (1 - e * e), left)
        # slip ends: stick, or slip in the direction in which slip grows
        restart = jnp.where(sticks, jnp.zeros(2, u.dtype), 4 * still * again)
        after = after.at[1:3].set(jnp.where(stopped, restart, after[1:3]))
        slides = jnp.where(stopped, ~sticks, slides)
        finished = done | (ended & restores) | (starts & (e == 0))
        args = (D, mu, stick, slides, restores | starts, new_left)
        y = jnp.where(done, y, carry_back(rate, end.t, after, args, end.located))
        new = (
            jnp.where(done, s, end.located), y, jnp.where(done, now[2], slides),
            restores | starts, jnp.where(done, left, new_left), finished,
            fine & (done | (end.success & end.reached)),
        )  # fmt: skip
        return new, None

    slides = (u[1:] ** 2).sum() > still * still
    start = jnp.concatenate([u, jnp.zeros(3, u.dtype)])
    zero = jnp.zeros((), u.dtype)
    given = (zero, start, slides, jnp.asarray(False), zero, jnp.asarray(False), jnp.asarray(True))
    (s, y, _, _, _, done, fine), _ = jax.lax.scan(phase, given, None, length=PHASES)
    return jnp.concatenate([s[None], y[4:6]]), done & fine


def _slip_direction(D: jax.Array, mu: jax.Array) -> jax.Array:
    """Return the unit direction d of slip that grows from rest, d || D_tn - mu D_tt d."""
    d = jnp.zeros(2, D.dtype)

    def turn(d: jax.Array, _: Any) -> tuple[jax.Array, None]:
        x = D[1:, 0] - mu * matvec(D[1:, 1:], d)
        square = (x * x).sum()
        return x / jnp.sqrt(jnp.where(square > 0, square, 1)), None

    return jax.lax.scan(turn, d, None, length=50)[0]
