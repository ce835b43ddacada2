"""Particles under ideal constraints, by the principle of D'Alembert (Olguin Diaz, 2.2.1).

The reactions of ideal constraints phi(t, x) = 0 do no work in a virtual displacement. They are
therefore linear combinations of the gradients of the constraints:

    m_i x_i'' = f_i + Phi_i^T lambda,    Phi = d phi / dx,    Phi x'' = -gamma

with gamma = d^2 phi / dt^2 at x'' = 0. Alternatively, if x(t, q) satisfies all constraints, the
reactions vanish from the sum of virtual works:

    sum (m_i x_i'' - f_i) . dx_i / dq = 0
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import jax
import jax.numpy as jnp

from rbjax.errors import InputError

Constraint = Callable[[Any, jax.Array], jax.Array]


class ParticleMotion(NamedTuple):
    """Acceleration x'' (n, d), multipliers (m,) and reactions (n, d) of constrained particles.

    `margin` is the smallest eigenvalue of Phi M^-1 Phi^T divided by the largest. If it is near 0,
    the constraints are linearly dependent, and the multipliers have no meaning.
    """

    acceleration: jax.Array
    multipliers: jax.Array
    reactions: jax.Array
    margin: jax.Array


def constrained_acceleration(
    masses: jax.Array,
    x: jax.Array,
    v: jax.Array,
    forces: jax.Array,
    constraint: Constraint,
    t: Any = 0.0,
) -> ParticleMotion:
    """Compute the acceleration of particles under constraints.

    masses: (n,).
    x, v, forces: (n, d) positions, velocities and applied forces.
    constraint: a function of (t, x) that returns phi (m,), which must be zero.

    >>> bob = constrained_acceleration(  # a pendulum, passing below at 3 m/s
    ...     jnp.array([2.0]), jnp.array([[0.0, -1.0]]), jnp.array([[3.0, 0.0]]),
    ...     jnp.array([[0.0, -20.0]]), lambda t, x: (x[0] @ x[0] - 1)[None] / 2)
    >>> bob.acceleration.tolist(), bob.multipliers.tolist()
    ([[0.0, 9.0]], [-38.0])
    """
    masses, x, v, forces = _particles("constrained_acceleration", masses, x, v, forces)
    t = jnp.asarray(t, x.dtype)
    phi, gamma = _second_rate(constraint, t, x, v)
    Phi = jax.jacobian(lambda x: constraint(t, x))(x).reshape(len(phi), -1)
    inverse = jnp.repeat(1 / masses, x.shape[1])
    A = ((Phi * inverse)[:, None, :] * Phi[None, :, :]).sum(-1)
    free = (Phi * inverse * forces.reshape(-1)).sum(-1)
    eigenvalues = jnp.linalg.eigvalsh(A)
    margin = eigenvalues[0] / eigenvalues[-1]
    if not isinstance(margin, jax.core.Tracer) and not margin > 16 * jnp.finfo(x.dtype).eps:
        raise InputError(
            f"constrained_acceleration: the {len(phi)} constraints depend on each other here "
            f"(margin {float(margin):.2g}), expected independent gradients; drop redundant ones"
        )
    multipliers = jnp.linalg.solve(A, -gamma - free)
    reactions = (Phi * multipliers[:, None]).sum(0).reshape(x.shape)
    return ParticleMotion((forces + reactions) / masses[:, None], multipliers, reactions, margin)


def constraint_error(
    constraint: Constraint, t: Any, x: jax.Array, v: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Compute the residual phi(t, x) (m,) of the constraints, and its time derivative (m,)."""
    t = jnp.asarray(t, x.dtype)
    return jax.jvp(constraint, (t, x), (jnp.ones_like(t), v))


def reduced_acceleration(
    masses: jax.Array,
    points: Callable[[Any, jax.Array], jax.Array],
    forces: jax.Array,
    q: jax.Array,
    qd: jax.Array,
    t: Any = 0.0,
) -> jax.Array:
    """Compute q'' (k,) of particles at `points(t, q)` (n, d) under applied forces (n, d).

    >>> bead = lambda t, q: jnp.stack([jnp.cos(q[0]), jnp.sin(q[0])])[None]
    >>> gravity = jnp.array([[0.0, -10.0]])
    >>> reduced_acceleration(jnp.ones(1), bead, gravity, jnp.zeros(1), jnp.ones(1)).tolist()
    [-10.0]
    """
    q, qd = jnp.asarray(q), jnp.asarray(qd)
    t = jnp.asarray(t, q.dtype)
    x, swept = _second_rate(points, t, q, qd)
    masses, x, _, forces = _particles("reduced_acceleration", masses, x, x, forces)
    J = jax.jacobian(lambda q: points(t, q))(q)
    M = (masses[:, None, None, None] * J[..., :, None] * J[..., None, :]).sum((0, 1))
    work = (J * (forces - masses[:, None] * swept)[..., None]).sum((0, 1))
    return jnp.linalg.solve(M, work)


def term(
    masses: jax.Array,
    forces: Callable[[Any, jax.Array, jax.Array], jax.Array],
    constraint: Constraint,
) -> diffrax.ODETerm:
    """Return the term for diffrax with y = (x, v). Drift from the constraints is not corrected."""

    def rate(t: Any, y: tuple[jax.Array, jax.Array], args: Any) -> tuple[jax.Array, jax.Array]:
        x, v = y
        moved = constrained_acceleration(masses, x, v, forces(t, x, v), constraint, t)
        return v, moved.acceleration

    return diffrax.ODETerm(rate)


def _second_rate(f: Constraint, t: jax.Array, x: jax.Array, v: jax.Array):
    """Compute f and its second time derivative along x' = v, x'' = 0."""
    one = jnp.ones_like(t)

    def rate(t: jax.Array, x: jax.Array):
        return jax.jvp(f, (t, x), (one, v))

    (value, _), (_, second) = jax.jvp(rate, (t, x), (one, v))
    return value, second


def _particles(where: str, masses: Any, x: Any, v: Any, forces: Any) -> list[jax.Array]:
    masses, x, v, forces = map(jnp.asarray, (masses, x, v, forces))
    if x.ndim != 2 or masses.shape != x.shape[:1] or not (v.shape == x.shape == forces.shape):
        raise InputError(
            f"{where}: masses {masses.shape}, positions {x.shape}, velocities {v.shape} and forces "
            f"{forces.shape}, expected (n,) and three times (n, d)"
        )
    return [masses, x, v, forces]
