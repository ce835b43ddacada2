"""Options of every method of `solve`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax

from rbjax.model.record import Record


class StoppingRule(NamedTuple):
    """When a search ends; each ().

    tolerance: of the expected decrease of the cost, relative to the larger of |cost| and scale.
    violation: of constraints.
    iterations: at most.
    scale: None: min(|cost of the first guess|, 1).
    """

    tolerance: jax.Array
    violation: jax.Array
    iterations: jax.Array
    scale: jax.Array | None = None


class Options(Record):
    """Options of every method.

    rule: when the search ends.
    seed: of random numbers.
    multipliers: of the constraints at the beginning; None for zeros.
    report: called with (iterations, cost, violation) after each iteration; None for no call.
    """

    rule: StoppingRule
    seed: jax.Array | int = 0
    multipliers: Any = None
    report: Callable[[Any, Any, Any], None] | None = eqx.field(static=True, default=None)
