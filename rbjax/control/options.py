"""What a caller may ask of every method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from rbjax.model.record import Record


class Options(Record):
    """tolerance of the foreseen change of the cost, relative to the cost; violation of constraints;
    iterations at most; seed of what is drawn; scale, the least cost to which the tolerance is
    relative, None for that of the first guess, at most 1; each (). multipliers of the constraints
    to begin with; None for zeros. say: called with (iterations, cost, violation) after each; None
    for nothing."""

    tolerance: jax.Array
    violation: jax.Array
    iterations: jax.Array
    seed: jax.Array | int = 0
    scale: jax.Array | None = None
    multipliers: Any = None
    say: Callable[[Any, Any, Any], None] | None = eqx.field(static=True, default=None)
