"""Checks of arguments that several functions of this package share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import check_array
from rbjax.errors import InputError


def check_is(where: str, name: str, value: Any, kind: type, made_by: str = "") -> None:
    """`InputError` unless value has a type. made_by: how one is made."""
    if not isinstance(value, kind):
        raise InputError(
            f"{where}: {name} is {type(value).__name__}, expected a {kind.__name__}{made_by}"
        )


def check_several(where: str, name: str, given: Any, expected: str) -> tuple:
    """The entries of a list or tuple."""
    if isinstance(given, str) or not isinstance(given, Iterable):
        raise InputError(f"{where}: {name} is {given!r}, expected a list of {expected}")
    return tuple(given)


def check_at_least(
    where: str, name: str, value: Any, *shapes: tuple[int, ...], least: float = 0.0
) -> jax.Array:
    """Finite numbers of one of the shapes, none below `least`."""
    x = check_array(where, name, value, *shapes)
    if not isinstance(x, jax.core.Tracer) and (np.asarray(x) < least).any():
        raise InputError(
            f"{where}: {name} is {np.asarray(x).tolist()}, expected numbers of at least {least:g}"
        )
    return x


def check_positive(where: str, name: str, value: Any, *shapes: tuple[int, ...]) -> jax.Array:
    """Finite numbers above zero, of one of the shapes."""
    x = check_array(where, name, value, *(shapes or ((),)))
    if not isinstance(x, jax.core.Tracer) and not (np.asarray(x) > 0).all():
        raise InputError(
            f"{where}: {name} is {np.asarray(x).tolist()}, expected numbers above zero"
        )
    return x


def check_bound(where: str, name: str, value: Any, *shapes: tuple[int, ...]) -> jax.Array:
    """Numbers of one of the shapes, infinite where there is no bound."""
    expected = " or ".join(map(str, shapes)) or "of numbers"
    try:
        x = jnp.asarray(value, float)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{where}: {name} is {value!r}, expected numbers, infinite without a bound"
        ) from error
    if shapes and x.shape not in shapes:
        raise InputError(f"{where}: {name} has shape {x.shape}, expected {expected}")
    if not isinstance(x, jax.core.Tracer) and np.isnan(np.asarray(x)).any():
        raise InputError(f"{where}: {name} is nan, expected numbers, infinite without a bound")
    return x


def check_reference(where: str, name: str, value: Any, shape: tuple[int, ...] | None) -> None:
    """`InputError` unless value is an array, finite if known, whose last axes have a shape (None:
    any). Leading axes are those of a batch."""
    try:
        x = jnp.asarray(value)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"{where}: {name} is {type(value).__name__}, expected numbers or a function of t"
        ) from error
    if shape is not None and x.shape[max(0, x.ndim - len(shape)) :] != shape:
        raise InputError(
            f"{where}: {name} has shape {x.shape}, expected {shape} or a function of t"
        )
    if not isinstance(x, jax.core.Tracer) and not np.isfinite(np.asarray(x)).all():
        raise InputError(f"{where}: {name} has numbers that are not finite, expected finite ones")


def check_rotation(where: str, R: Any) -> None:
    """`InputError` unless known matrices (..., 3, 3) are rotations."""
    if R is None or isinstance(R, jax.core.Tracer):
        return
    known = np.asarray(R, np.float64)
    off = np.abs(known @ np.swapaxes(known, -1, -2) - np.eye(3)).max()
    det = np.linalg.det(known).min()
    if off > 1e-4 or det < 0:
        raise InputError(
            f"{where}: rotation is no rotation matrix (R R^T - 1 has an entry {off:.2g}, det "
            f"{det:.2g}); rbjax.rotations.so3.project gives the nearest"
        )


def check_key(where: str, key: Any) -> None:
    """`InputError` unless key is one of `jax.random`."""
    is_key = isinstance(key, jax.Array) and (
        jnp.issubdtype(key.dtype, jax.dtypes.prng_key) or (key.dtype == jnp.uint32 and key.ndim)
    )
    if not is_key:
        raise InputError(
            f"{where}: key is {key!r}, expected a key of jax.random, such as jax.random.key(0)"
        )


def check_optimiser(where: str, optimiser: Any) -> None:
    """`InputError` unless optimiser is a transformation of optax, or None."""
    if optimiser is not None and not (hasattr(optimiser, "init") and hasattr(optimiser, "update")):
        raise InputError(
            f"{where}: optimiser is {optimiser!r}, expected a transformation of optax, such as "
            "optax.adam(1e-3)"
        )


def check_shapes(where: str, given: Sequence[tuple[str, Any, tuple[int, ...]]]) -> tuple:
    """Arrays by name, each of one shape, finite if known."""
    return tuple(check_array(where, name, value, shape) for name, value, shape in given)
