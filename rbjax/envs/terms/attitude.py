"""Terms of the attitude of a frame. R is its rotation matrix and z = R e_z its vertical axis."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp

from rbjax.envs.terms.frames import Term, frame_at, scalar, squares
from rbjax.sensors.fixed import reading


def gravity_direction(frame: Any) -> Term:
    """Observe the direction of gravity (3,) in the axes of a frame: -R^T e_z."""

    def read(transition: Any) -> jax.Array:
        return reading(transition.after, -frame_at(transition.after, frame).rotation.rows[2])

    return read


def tilt(frame: Any) -> Term:
    """Return the squared sine of the angle between z and the vertical: z_x^2 + z_y^2."""

    def read(transition: Any) -> jax.Array:
        z = frame_at(transition.after, frame).rotation.columns[2]
        return scalar(transition.after, squares((z[0], z[1])))

    return read


def axis_error(frame: Any, target: tuple[float, float, float]) -> Term:
    """Return |z - target|^2 of the vertical axis z of a frame, in world axes."""

    def read(transition: Any) -> jax.Array:
        z = frame_at(transition.after, frame).rotation.columns[2]
        return scalar(transition.after, squares(a - b for a, b in zip(z, target, strict=True)))

    return read


def fallen(frame: Any, least: float = 0.0) -> Term:
    """Check whether z_z < least, the cosine of the angle from the vertical. Zero is 90 degrees."""

    def read(transition: Any) -> jax.Array:
        return jnp.asarray(frame_at(transition.after, frame).rotation.columns[2][2] < least)

    return read
