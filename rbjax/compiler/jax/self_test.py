"""Whether programs run on a device here: one doubles some numbers, at first use."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

from rbjax.compiler.ir.values import Unsupported

#: as many as a kernel's block has threads
NUMBERS = np.arange(32, dtype=np.float32)


def passes(double: Callable[[np.ndarray], Any], warning: str) -> bool:
    """Whether double(x) = 2 x. A failure warns: its reason takes the place of `{}` in `warning`."""
    try:
        if np.array_equal(double(NUMBERS), 2 * NUMBERS):
            return True
        problem = "the self-test's result is wrong"
    except (Unsupported, RuntimeError) as error:  # those of JAX and of compilers are RuntimeErrors
        problem = str(error)[:300]
    warnings.warn(warning.format(problem), stacklevel=3)
    return False
