"""What a caller may ask of every method."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import equinox as eqx
import jax

from rbjax.model.record import Record


class Options(Record):
    """tolerance of the foreseen change of the cost; violation of constraints; iterations at most;
    seed of what is drawn; each (). say: called with (iterations, cost, violation) after each; None
    for nothing."""

    tolerance: jax.Array
    violation: jax.Array
    iterations: jax.Array
    seed: jax.Array | int = 0
    say: Callable[[Any, Any, Any], None] | None = eqx.field(static=True, default=None)
