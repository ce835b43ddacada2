"""Limits of controls, forces and states."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.lanes import Lane, is_literal
from rbjax.model.links import lane


def clip(x: Lane, limits: Any, i: int) -> Lane:
    """x within row i of the limits (n, 2); unchanged if these are known to be infinite."""
    low, high = lane(limits[:, 0], i), lane(limits[:, 1], i)
    if is_literal(low) and np.isneginf(low) and np.isposinf(high):
        return x
    return jnp.clip(x, jnp.asarray(low, x.dtype), jnp.asarray(high, x.dtype))
