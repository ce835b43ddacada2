"""A function of each of several arguments: all at once, or one after another."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax


def each(f: Callable, *xs: Any) -> Any:
    """f of each row of the arguments, its results stacked.

    A processor computes all rows at once. A GPU thread computes one after another, in a loop: its
    program has f once, and what f needs in between it needs for one row, also where f is
    differentiated.
    """

    def loop(*xs: Any) -> Any:
        return jax.lax.map(jax.checkpoint(lambda x: f(*x)), xs)

    return jax.lax.platform_dependent(*xs, cuda=loop, default=jax.vmap(f))
