"""Checks of the matrices of linear systems."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.dynamics.arguments import check_array, shape_of
from rbjax.errors import InputError
from rbjax.kinematics.arguments import known_array


def check_matrices(where: str, *matrices: tuple[str, Any, str]) -> list[jax.Array]:
    """Convert matrices to one dtype; raise InputError unless their shapes match.

    matrices: (name, value, axes), with a letter for each axis, such as ("B", B, "nm"). Axes with
        the same letter must have the same length.
    """
    lengths: dict[str, int] = {}
    found = []
    for name, value, axes in matrices:
        shape = shape_of(where, name, value)
        if len(shape) == len(axes):
            for axis, length in zip(axes, shape, strict=True):
                lengths.setdefault(axis, length)
        if shape != tuple(lengths.get(axis) for axis in axes) or 0 in shape:
            hint = "; for a batch use jax.vmap" if len(shape) == len(axes) + 1 else ""
            due = ", ".join(str(lengths.get(axis) or axis) for axis in axes)
            raise InputError(f"{where}: {name} has shape {shape}, expected ({due}){hint}")
        found.append(check_array(where, name, value, shape))
    dtype = jnp.result_type(*found)
    return [x.astype(dtype) for x in found]


def weight_matrix(where: str, name: str, value: Any, n: int) -> jax.Array:
    """Return a matrix (n, n) from a matrix or its diagonal (n,)."""
    x = check_array(where, name, value, (n, n), (n,))
    return jnp.diag(x) if x.ndim == 1 else x


def check_regulator(where: str, A: Any, B: Any, Q: Any, R: Any, S: Any) -> tuple[jax.Array, ...]:
    """Check A, B, Q, R and S of a regulator and convert them to one dtype. Raise InputError if Q or
    R is not symmetric; traced values pass."""
    A, B = check_matrices(where, ("A", A, "nn"), ("B", B, "nm"))
    n, m = B.shape
    Q, R = weight_matrix(where, "Q", Q, n), weight_matrix(where, "R", R, m)
    for name, W in (("Q", Q), ("R", R)):
        known = known_array(W)
        if known is None:
            continue
        off = np.abs(known - known.T).max()
        if off > np.sqrt(np.finfo(W.dtype).eps) * np.abs(known).max():
            raise InputError(
                f"{where}: {name} is not symmetric, {name} - {name}' has entries up to {off:.3g}; "
                f"give ({name} + {name}') / 2"
            )
    S = jnp.zeros_like(B) if S is None else check_array(where, "S", S, (n, m))
    dtype = jnp.result_type(A, B, Q, R, S)
    return tuple(x.astype(dtype) for x in (A, B, Q, R, S))
