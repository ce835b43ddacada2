"""Functions that a constraint holds.

A function is static, a part of the program. It is compared by identity: define it once, and a model
with it is compiled once. What it closes over is fixed; what shall be differentiated, batched or
changed is in `numbers`, a pytree of leaves, which the function takes as its last argument.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.model.record import check_numbers


def arrays(numbers: Any) -> Any:
    """The pytree with arrays for its numbers."""
    try:
        return jax.tree.map(jnp.asarray, numbers)
    except (TypeError, ValueError) as error:
        raise InputError(
            f"numbers of a constraint's function: got {numbers!r}, expected a pytree of numbers"
        ) from error


def check_function(where: str, f: Any) -> None:
    """Refuse what cannot be called, or cannot be a part of a program."""
    if not callable(f):
        raise InputError(f"{where}: got {type(f).__name__}, expected a function")
    try:
        hash(f)
    except TypeError as error:
        raise InputError(
            f"{where}: got a {type(f).__name__} without a hash, expected a function; give it its "
            "arrays as `numbers`"
        ) from error


def check_size(where: str, size: Any) -> None:
    """Refuse what counts no rows."""
    if isinstance(size, bool) or not isinstance(size, (int, np.integer)) or size < 1:
        raise InputError(f"{where}: got {size!r}, expected a whole number of rows, at least 1")


def check_leaves(where: str, numbers: Any) -> None:
    """Refuse numbers that are not finite."""
    for x in jax.tree.leaves(numbers):
        check_numbers(where, x, endless=False)


def evaluate(
    where: str, f: Callable, numbers: Any, args: tuple, shape: tuple[int, ...], dtype: Any
) -> jax.Array:
    """f(*args), or f(*args, numbers) where there are numbers, of this shape and dtype."""

    def cast(x: Any) -> jax.Array:
        x = jnp.asarray(x)
        return x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x

    out = f(*args) if numbers is None else f(*args, jax.tree.map(cast, numbers))
    if not hasattr(out, "dtype"):
        try:
            out = jnp.asarray(out, dtype)
        except (TypeError, ValueError) as error:
            raise InputError(
                f"{where} returned {type(out).__name__}, expected an array of shape {shape}"
            ) from error
    if out.shape != shape:
        raise InputError(f"{where} returned the shape {out.shape}, expected {shape}")
    return jnp.asarray(out, dtype)
