"""Arguments of the Kalman filter: covariances, samples, and functions that fit them."""

from __future__ import annotations

import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.arguments import real_array, shown
from rbjax.errors import InputError


def matrix(name: str, x: Any, where: str = "kalman_filter") -> jax.Array:
    x = real(where, name, x, "variances (n,) or a matrix (n, n), of finite numbers")
    if x.ndim == 1:
        return jnp.diag(x)
    if x.ndim != 2 or x.shape[0] != x.shape[1]:
        raise InputError(
            f"{where}: {name} has shape {x.shape}, expected variances (n,) or a matrix (n, n)"
        )
    return x


def real(where: str, name: str, x: Any, expected: str, *, finite: bool = True) -> jax.Array:
    """x as an array of floating-point numbers; known ones are checked."""
    if not isinstance(x, jax.core.Tracer):
        dtype = getattr(x, "dtype", None)
        x = real_array(where, name, x, expected, finite=finite)
        dtype = dtype if dtype is not None and jnp.issubdtype(dtype, jnp.floating) else None
        return jnp.asarray(x, float if dtype is None else dtype)
    return x if jnp.issubdtype(x.dtype, jnp.floating) else x.astype(float)


def check_fits(where: str, space: Any, state: Any, P: jax.Array, given: Any, W: Any) -> None:
    """Reject a covariance, or process noise, that is not of the states of a `StateSpace`. given:
    the inputs of a step; W: None if no step is made."""
    if space.box_plus is not operator.add:
        return
    shape = jnp.shape(state)
    if shape != P.shape[:1]:
        raise InputError(
            f"{where}: the state has shape {shape} and its covariance {P.shape}, expected (n,) and "
            "(n, n)"
        )
    if W is None:
        return
    new = jax.eval_shape(space.move, state, given, jnp.zeros(W.shape[0], W.dtype))
    if getattr(new, "shape", None) != shape:
        raise InputError(
            f"{where}: move makes {getattr(new, 'shape', type(new).__name__)} of a state {shape} "
            f"with noise of shape {W.shape[:1]}, expected {shape}: process has one variance for "
            "each entry of w"
        )


def check_inputs(where: str, inputs: Any, samples: bool) -> None:
    """Reject inputs that are not arrays of numbers; of several samples: with a row for each."""
    expected = "arrays (N, ...), one row a step" if samples else "arrays of numbers"
    for x in jax.tree.leaves(inputs):
        numeric = isinstance(x, jax.Array) or np.asarray(x).dtype.kind in "biuf"
        if not numeric or (samples and 0 in (*jnp.shape(x), jnp.ndim(x))):
            raise InputError(f"{where}: inputs contain {shown(x)}, expected {expected}")
