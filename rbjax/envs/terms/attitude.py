"""Terms of the attitude of a frame. R is its rotation matrix and z = R e_z its vertical axis."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.arguments import real_array, real_number, shown
from rbjax.envs.terms.frames import Term, frame_at, scalar, squares
from rbjax.errors import InputError
from rbjax.sensors.fixed import reading


def gravity_direction(frame: Any) -> Term:
    """Return the term that observes the direction of gravity in the axes of a frame, -R^T e_z.

    Args:
        frame: name of a site or of a body, or an `rb.Frame`.

    Returns:
        Function of a `Transition` that returns a unit vector (3,).

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Observation("gravity", rb.envs.terms.gravity_direction("imu"), noise=0.05).noise
        0.05
    """

    def read(transition: Any) -> jax.Array:
        return reading(transition.after, -frame_at(transition.after, frame).rotation.rows[2])

    return read


def tilt(frame: Any) -> Term:
    """Return the term: the squared sine of the angle between z and the vertical, z_x^2 + z_y^2.

    Args:
        frame: name of a site or of a body, or an `rb.Frame`.

    Returns:
        Function of a `Transition` that returns (), without unit.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("upright", rb.envs.terms.tilt("imu"), -5.0).weight
        -5.0
    """

    def read(transition: Any) -> jax.Array:
        z = frame_at(transition.after, frame).rotation.columns[2]
        return scalar(transition.after, squares((z[0], z[1])))

    return read


def axis_error(frame: Any, target: tuple[float, float, float]) -> Term:
    """Return the term: |z - target|^2 of the vertical axis z of a frame, in world axes.

    Args:
        frame: name of a site or of a body, or an `rb.Frame`.
        target: unit vector (3,) in world axes.

    Returns:
        Function of a `Transition` that returns (), without unit.

    Raises:
        InputError: a target that is not three finite numbers.

    Example:
        >>> import rbjax as rb
        >>> rb.envs.Reward("level", rb.envs.terms.axis_error("imu", (0.0, 0.0, 1.0)), -1.0).weight
        -1.0
    """
    if real_array("axis_error", "target", target).shape != (3,):
        raise InputError(f"axis_error: target is {shown(target)}, expected three numbers")

    def read(transition: Any) -> jax.Array:
        z = frame_at(transition.after, frame).rotation.columns[2]
        return scalar(transition.after, squares(a - b for a, b in zip(z, target, strict=True)))

    return read


def fallen(frame: Any, least: float = 0.0) -> Term:
    """Return the termination: whether z_z < least, the cosine of the angle from the vertical.

    Args:
        frame: name of a site or of a body, or an `rb.Frame`.
        least: the least cosine of a robot that stands; zero is 90 degrees.

    Returns:
        Function of a `Transition` that returns () of bool, a value of `Task.terminations`.

    Raises:
        InputError: a least that is not a finite number.

    Example:
        >>> import rbjax as rb
        >>> terminations = {"fallen": rb.envs.terms.fallen("imu", 0.5)}
        >>> callable(terminations["fallen"])
        True
    """
    real_number("fallen", "least", least)

    def read(transition: Any) -> jax.Array:
        return jnp.asarray(frame_at(transition.after, frame).rotation.columns[2][2] < least)

    return read
