"""What a caller may ask of every method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from rbjax.model.record import Record


class Options(Record):
    """Options of every method; numbers have the shape ().

    tolerance: of the predicted change of the cost, relative to the larger of |cost| and scale.
    violation: of constraints.
    iterations: at most.
    seed: of random numbers.
    scale: None: min(|cost of the first guess|, 1).
    multipliers: of the constraints at the beginning; None for zeros.
    say: called with (iterations, cost, violation) after each iteration; None for no call.
    """

    tolerance: jax.Array
    violation: jax.Array
    iterations: jax.Array
    seed: jax.Array | int = 0
    scale: jax.Array | None = None
    multipliers: Any = None
    say: Callable[[Any, Any, Any], None] | None = eqx.field(static=True, default=None)
