"""Terms of the velocity of a frame: tracking of commands, and undesired velocities.

v and w are the velocities of the origin and of rotation. The command is (c_x, c_y, c_w), a
horizontal velocity in m/s and a yaw rate in rad/s, in the axes of the frame.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs.terms.frames import Term, frame_at, scalar, squares


def track_velocity(frame: Any, command: str = "command", width: float = 0.25) -> Term:
    """Reward the commanded horizontal velocity: exp(-((c_x - v_x)^2 + (c_y - v_y)^2) / width).

    frame: site or body, in whose axes the command is. command: variable (3,) of the task.
    width: in m^2/s^2.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("speed", rb.envs.terms.track_velocity("imu")).weight
        1.0
    """

    def read(transition: Any) -> jax.Array:
        c, v = transition.variables[command], frame_at(transition.after, frame).twist.lin
        return jnp.exp(-squares((c[0] - v[0], c[1] - v[1])) / width)

    return read


def track_yaw_rate(frame: Any, command: str = "command", width: float = 0.25) -> Term:
    """Reward the commanded yaw rate: exp(-(c_w - w_z)^2 / width). width: in rad^2/s^2."""

    def read(transition: Any) -> jax.Array:
        return jnp.exp(
            -squares(
                [transition.variables[command][2] - frame_at(transition.after, frame).twist.ang[2]]
            )
            / width
        )

    return read


def vertical_velocity(*frames: Any) -> Term:
    """Return the sum of v_z^2 over frames, v in world axes."""

    def read(transition: Any) -> jax.Array:
        return scalar(
            transition.after, squares(frame_at(transition.after, f).velocity[2] for f in frames)
        )

    return read


def roll_and_pitch_rate(frame: Any) -> Term:
    """Return w_x^2 + w_y^2 of a frame, w in world axes."""

    def read(transition: Any) -> jax.Array:
        w = frame_at(transition.after, frame).angular_velocity
        return scalar(transition.after, squares((w[0], w[1])))

    return read
