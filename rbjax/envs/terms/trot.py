"""A trot by a velocity command, as a reference for the joints of a quadruped.

With the phase p = 2 pi f t of a leg, the other pair of diagonal legs half a period later, the
velocity (u, v) of the hip by the command, and the length l of the leg:

    leg angle forward = -u cos(p) / (4 f l),   sideways = v (-cos p) / (4 f l)
    knee and hip bend by max(sin p, 0)

A foot moves forward while it is lifted, and back at about the commanded velocity while it stands.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs.episode import Params
from rbjax.envs.terms.frames import Term


def trot_distance(
    home: Sequence[float], hips: Sequence[tuple[float, float]], length: float, lift: float = 0.3,
    frequency: float = 2.0,
) -> Term:  # fmt: skip
    """Return -|q - h|^2 of the joints, with the angles h of a trot by the command.

    Use it as a guide at the beginning of a training by gradients.

    Args:
        home: (12,) angles of the standing robot, for each leg hip, thigh, knee; diagonal legs are
            the first and the last one. The joints are the last 12 of the robot.
        hips: (4,) x and y of the hips in the trunk, m.
        length: from hip to foot of the standing robot, m.
        lift: angle of the thigh that lifts a foot, rad; the knee bends by twice as much.
        frequency: of the trot, Hz.

    Example:
        >>> import rbjax as rb
        >>> hips = [(0.2, -0.1), (0.2, 0.1), (-0.2, -0.1), (-0.2, 0.1)]
        >>> callable(rb.envs.terms.trot_distance([0.0, 0.9, -1.8] * 4, hips, 0.27))
        True
    """

    def read(transition: Any) -> jax.Array:
        q = transition.after.q[-12:]
        t = transition.dt * jnp.asarray(transition.step, q.dtype)
        angles = trot_angles(
            t, transition.variables["command"], home, hips, length, lift, frequency
        )
        return -((q - angles) ** 2).sum()

    return read


def trot_angles(
    t: jax.Array, command: jax.Array, home: Sequence[float], hips: Sequence[tuple[float, float]],
    length: float, lift: float, frequency: float,
) -> jax.Array:  # fmt: skip
    """Compute the joint angles (12,) of a trot at the time t, s, by a command (3,): vx, vy in m/s,
    yaw rate in rad/s. The other arguments are those of `trot_distance`."""
    dtype = command.dtype
    x, y = jnp.asarray(hips, dtype).T
    phase = 2 * jnp.pi * frequency * t + jnp.pi * jnp.asarray([0.0, 1.0, 1.0, 0.0], dtype)
    swing = -jnp.cos(phase) / (4 * frequency * length)
    up = lift * jnp.maximum(jnp.sin(phase), 0.0)
    forward, sideways = command[0] - command[2] * y, command[1] + command[2] * x
    offsets = jnp.stack([swing * sideways, up - swing * forward, -2 * up], 1)
    return jnp.asarray(home, dtype) + offsets.reshape(-1)


def guide_until(name: str, weight: float, until: float) -> Any:
    """Return a curriculum that lowers the weight of a reward term linearly to zero.

    Args:
        name: of the reward term.
        weight: at the beginning of the training.
        until: progress of the training from which on the weight is zero.
    """

    def curriculum(params: Params, progress: Any) -> Params:
        share = jnp.maximum(0.0, 1 - progress / until)
        weights = {**params.weights, name: weight * share * jnp.ones_like(params.weights[name])}
        return params.replace(weights=weights)

    return curriculum
