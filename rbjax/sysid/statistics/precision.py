"""Floating-point precision of identification: float64.

Rank, covariance and convergence compare singular values over 9 decades. float32, JAX's default,
resolves 7. Each estimator computes in float64, and returns the model in its original dtype.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

P = ParamSpec("P")
R = TypeVar("R")


def in_double(f: Callable[P, R]) -> Callable[P, R]:
    """Decorate a function to run with float64 as the default float of JAX."""

    @functools.wraps(f)
    def run(*args: P.args, **options: P.kwargs) -> R:
        with jax.enable_x64(True):
            return f(*args, **options)

    return run


def cast(tree: Any, dtype: Any) -> Any:
    """Convert the floating-point arrays of a pytree to a dtype."""

    def one(x: Any) -> Any:
        old = getattr(x, "dtype", None)
        if old is None or old == dtype or not jnp.issubdtype(old, jnp.floating):
            return x
        # cast with numpy, since JAX compiles a cast for every shape
        return jnp.asarray(np.asarray(x).astype(dtype))

    return jax.tree.map(one, tree)
