"""The module that JAX lowers for a GPU, on a machine without one."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax


def lowered(g: Callable, *args: Any) -> str:
    return jax.jit(g).trace(*args).lower(lowering_platforms=("cuda",)).as_text()
