"""Terms of the velocity of a frame: tracking of commands, and undesired velocities.

v and w are the velocities of the origin and of rotation. The command is (c_x, c_y, c_w), a
horizontal velocity in m/s and a yaw rate in rad/s, in the axes of the frame.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import real_number
from rbjax.envs.terms.frames import Term, frame_at, scalar, squares, variable_of
from rbjax.errors import InputError


def track_velocity(frame: Any, command: str = "command", width: float = 0.25) -> Term:
    """Return the reward of a commanded horizontal velocity: exp(-|c_xy - v_xy|^2 / width).

    Args:
        frame: name of a site or of a body, or an `rb.Frame`; c and v are in its axes.
        command: name of the variable (3,) of the task with the command: c_x, c_y in m/s, c_w in
            rad/s.
        width: of the reward, m^2/s^2.

    Returns:
        Function of a `Transition` that returns (), from 0 to 1.

    Raises:
        InputError: a width that is not above zero.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("speed", rb.envs.terms.track_velocity("imu")).weight
        1.0
    """
    real_number("track_velocity", "width", width, above=0.0)

    def read(transition: Any) -> jax.Array:
        c, v = command_of(transition, command), frame_at(transition.after, frame).twist.lin
        return jnp.exp(-squares((c[0] - v[0], c[1] - v[1])) / width)

    return read


def track_yaw_rate(frame: Any, command: str = "command", width: float = 0.25) -> Term:
    """Return the reward of a commanded yaw rate: exp(-(c_w - w_z)^2 / width).

    Args:
        frame: name of a site or of a body, or an `rb.Frame`; w_z is in its axes.
        command: name of the variable (3,) of the task with the command: c_x, c_y in m/s, c_w in
            rad/s.
        width: of the reward, rad^2/s^2.

    Returns:
        Function of a `Transition` that returns (), from 0 to 1.

    Raises:
        InputError: a width that is not above zero.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("turn", rb.envs.terms.track_yaw_rate("imu"), 0.5).weight
        0.5
    """
    real_number("track_yaw_rate", "width", width, above=0.0)

    def read(transition: Any) -> jax.Array:
        c, w = command_of(transition, command), frame_at(transition.after, frame).twist.ang
        return jnp.exp(-squares([c[2] - w[2]]) / width)

    return read


def command_of(transition: Any, name: str) -> Any:
    """Return a command (3,), a variable of the task."""
    found = variable_of(transition, name)
    if len(found) != 3:
        raise InputError(
            f"the variable {name!r} of the task has {len(found)} entries, expected a command of 3: "
            "c_x, c_y in m/s, c_w in rad/s"
        )
    return found


def vertical_velocity(*frames: Any) -> Term:
    """Return the term: the sum of v_z^2 over frames, v in world axes.

    Args:
        frames: names of sites or of bodies, or `rb.Frame`s.

    Returns:
        Function of a `Transition` that returns (), m^2/s^2.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("bounce", rb.envs.terms.vertical_velocity("imu"), -0.5).weight
        -0.5
    """

    def read(transition: Any) -> jax.Array:
        return scalar(
            transition.after, squares(frame_at(transition.after, f).velocity[2] for f in frames)
        )

    return read


def roll_and_pitch_rate(frame: Any) -> Term:
    """Return the term: w_x^2 + w_y^2 of a frame, w in world axes.

    Args:
        frame: name of a site or of a body, or an `rb.Frame`.

    Returns:
        Function of a `Transition` that returns (), rad^2/s^2.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("rolling", rb.envs.terms.roll_and_pitch_rate("imu"), -0.05).weight
        -0.05
    """

    def read(transition: Any) -> jax.Array:
        w = frame_at(transition.after, frame).angular_velocity
        return scalar(transition.after, squares((w[0], w[1])))

    return read
