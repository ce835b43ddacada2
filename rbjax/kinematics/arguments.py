"""Checks of arguments of inverse kinematics and control: ranges, bounds, lists, rotations, keys."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import shown
from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError


def check_frame(where: str, site: Any, body: Any) -> None:
    """Raise InputError unless exactly one of site and body is given, as a string."""
    if (site is None) == (body is None):
        got = "neither" if site is None else "both"
        raise InputError(f"{where}: got {got} of site and body, expected exactly one")
    if not isinstance(body if site is None else site, str):
        raise InputError(f"{where}: got site={site!r} and body={body!r}, expected a name")


def known_array(x: Any) -> np.ndarray | None:
    """Return x as a NumPy array, or None if it is traced."""
    return None if isinstance(x, jax.core.Tracer) else np.asarray(x, float)


def check_several(where: str, name: str, given: Any, expected: str) -> tuple:
    """Return the entries of an iterable as a tuple; raise InputError for a string."""
    if isinstance(given, str | bytes) or not isinstance(given, Iterable):
        raise InputError(f"{where}: {name} is {given!r}, expected a list of {expected}")
    return tuple(given)


def check_not_negative(where: str, name: str, value: Any, *shapes: tuple[int, ...]) -> jax.Array:
    """Convert to an array of one of the shapes. Raise InputError if an entry is negative."""
    x = check_array(where, name, value, *shapes)
    known = known_array(x)
    if known is not None and (known < 0).any():
        raise InputError(f"{where}: {name} is {known.tolist()}, expected numbers of at least 0")
    return x


def check_bound(where: str, name: str, value: Any, *shapes: tuple[int, ...]) -> jax.Array:
    """Convert to an array of one of the shapes, whose infinite entries mean "no bound"."""
    expected = " or ".join(map(str, shapes)) or "of numbers"
    try:
        x = jnp.asarray(value, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(
            f"{where}: {name} is {shown(value)}, expected numbers, infinite without a bound"
        ) from error
    if shapes and x.shape not in shapes:
        raise InputError(f"{where}: {name} has shape {x.shape}, expected {expected}")
    known = known_array(x)
    if known is not None and np.isnan(known).any():
        raise InputError(f"{where}: {name} is nan, expected numbers, infinite without a bound")
    return x


def check_rotation(where: str, R: Any) -> None:
    """Raise InputError unless R (..., 3, 3) contains rotation matrices. Traced values pass."""
    if R is None or isinstance(R, jax.core.Tracer):
        return
    known = np.asarray(R, np.float64)
    off = np.abs(known @ np.swapaxes(known, -1, -2) - np.eye(3)).max()
    det = np.linalg.det(known).min()
    if off > 1e-4 or det < 0:
        raise InputError(
            f"{where}: rotation is not a rotation matrix (R R^T - 1 has an entry {off:.2g}, det "
            f"{det:.2g}); rbjax.rotations.so3.project gives the nearest"
        )
