"""What all recommendations check and compute in."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError

ROUNDS = 5  # of the clock
FINEST = 1e-10  # accuracy at which the reference's own error matters


def check_request(accuracy: Any, **times: Any) -> None:
    """Refuse an accuracy that is no number or too fine, and times that are no positive numbers."""
    for name, x in (("accuracy", accuracy), *times.items()):
        if np.ndim(x) or np.asarray(x).dtype.kind not in "iuf":
            raise InputError(f"recommend: {name} is {x!r}, expected a number")
    if not accuracy >= FINEST:
        raise InputError(
            f"recommend: accuracy is {accuracy}, expected at least {FINEST:.0e}: the reference is "
            "not more accurate"
        )
    for name, x in times.items():
        if not 0 < x < math.inf:
            raise InputError(f"recommend: {name} is {x}, expected a positive time in seconds")


def fastest(run: Callable[[], object], seconds: float = 0.0) -> float:
    """Seconds of the fastest of at least five runs, which take at least so many seconds."""
    taken: list[float] = []
    while len(taken) < ROUNDS or sum(taken) < seconds:
        begin = time.perf_counter()
        run()
        taken.append(time.perf_counter() - begin)
    return min(taken)


def double(x: Any) -> Any:
    floating = jnp.issubdtype(jnp.result_type(x), jnp.floating)
    return jnp.asarray(x, jnp.float64) if floating else x
