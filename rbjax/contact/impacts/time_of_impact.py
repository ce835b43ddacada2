"""Corrections of a time step for the time of impact within it.

A step h that ends with the velocity of an impact, and moves with it for the whole step, ignores the
time before the impact. The error of the position is of order h and changes sign with the phase of
the step, so its derivative is wrong however small h is. Within a step the free acceleration a is
constant, so the gap of a contact with normal velocity u and acceleration alpha is zero at

    gap + u s + alpha s^2 / 2 = 0,    s = 2 gap / (-u + sqrt(u^2 - 2 alpha gap))
An impact with restitution e reverses the normal velocity -w = u + alpha s to e w at s. At the end
of the step the velocity is e w + alpha (h - s), and the contact has moved by
e w (h - s) + alpha (h - s)^2 / 2 since s. The derivative of these is the saltation matrix.

Source: Zhong, Han, Dey & Brikis, *Improving gradient computation for differentiable physics
simulation with contacts*, 2023; Hu et al., *DiffTaichi*, 2020; Leine & Nijmeijer, *Dynamics and
Bifurcations of Non-Smooth Mechanical Systems*, ch. 7 (saltation matrix).
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rbjax.contact.impacts.impulse_equations import ImpulseProblem

#: m/s, below which a contact does not slip
STILL = 1e-12


class Touchdown(NamedTuple):
    """The events of n candidate contacts in a step.

    Fields:
        active: (n,) whether the contact closes within the step, or touches at its start. Bodies
            that fall together touch without closing, and other contacts may press them together.
        leaves: (n,) whether it leaves again, by restitution.
        velocity: (n,) m/s, least normal velocity at the end of the step.
        mean: (n,) m/s, least mean normal velocity over the step.
        part: (n,) the part of the step over which an impulse moves the bodies: (h - s) / h after an
            impact, 1/2 if the force is constant over the step.
    """

    active: jax.Array
    leaves: jax.Array
    velocity: jax.Array
    mean: jax.Array
    part: jax.Array


def touchdown(
    gap: jax.Array, u: jax.Array, alpha: jax.Array, e: jax.Array, rest_speed: jax.Array,
    correction: jax.Array, h: jax.Array,
) -> Touchdown:  # fmt: skip
    """Compute the events of contacts in a step h.

    Args:
        gap: (n,) distances at the start of the step, m.
        u, alpha: (n,) normal velocities at its start and free normal accelerations.
        e: (n,) restitution.
        rest_speed: m/s, below which there is no restitution.
        correction: the share of a penetration that a step removes.
        h: s.
    """
    closes = gap + h * u + 0.5 * h * h * alpha <= 0
    touches = gap <= rest_speed * h
    above = closes & (gap > 0)
    square = jnp.where(above, u * u - 2.0 * alpha * gap, 1.0)
    root = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    below = jnp.where(above & (root > u), root - u, 1.0)
    s = jnp.where(above, jnp.clip(2.0 * gap / below, 0.0, h), 0.0)
    w = -(u + alpha * s)
    left = h - s
    after = e * w + alpha * left
    leaves = closes & (w > rest_speed) & (after > 0)
    moved = (e * w + 0.5 * alpha * left) * left
    end = jnp.where(leaves, moved, 0.0)
    start = jnp.where(gap > 0, gap, jnp.where(leaves, 0.0, correction * gap))
    least = jnp.where(closes, 0.0, -jnp.maximum(gap, 0.0) / h)
    return Touchdown(
        closes | touches, leaves, jnp.where(leaves, after, least), (end - start) / h,
        jnp.where(leaves, left / h, 0.5),
    )  # fmt: skip


def end_of_slip(problem: ImpulseProblem, p: jax.Array, slip: jax.Array) -> jax.Array:
    """Compute the friction impulses (n, 2) to add to p in the mean velocity of a step, for contacts
    that begin to stick within the step.

    The mean velocity of a step with constant forces has half of p. Under full friction the slip
    would decrease linearly from u to w < 0 over the step. It ends after the part u / (u - w) of the
    step. Friction is full before that time, and holds the contact after it.

    Args:
        problem: velocities without impulses, and friction.
        p: (n, 3) impulses of the step.
        slip: (n, 2) tangential velocities at the start of the step.
    """
    square = (slip * slip).sum(-1, keepdims=True)
    slips = square > STILL * STILL
    speed = jnp.sqrt(jnp.where(slips, square, 1.0))
    along = jnp.where(slips, slip / speed, 0.0)
    full = p.at[:, 1:].set(-problem.friction(p[:, 0])[:, None] * along)
    later = problem.relative_velocity(full)
    w = (later[:, 1:] * along).sum(-1, keepdims=True)
    ends = slips & (w < 0) & problem.active[:, None]
    part = jnp.where(ends, speed / jnp.where(ends, speed - w, 1.0), 0.0)
    return 0.5 * part * jnp.where(ends, full[:, 1:] - p[:, 1:], 0.0)
