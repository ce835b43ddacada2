"""What a caller may ask of every method."""

from __future__ import annotations

import jax

from rbjax.model.record import Record


class Options(Record):
    """tolerance of the foreseen change of the cost; violation of constraints; iterations at most;
    seed of what is drawn; each ()."""

    tolerance: jax.Array
    violation: jax.Array
    iterations: jax.Array
    seed: jax.Array | int = 0
