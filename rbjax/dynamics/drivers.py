"""Drivers: how a recursion over the tree runs.

A recursion is written once, as a step on the lanes of one link; a driver walks the tree with it:

- `Unrolled` writes the steps one after another into the program. Structural zeros differ from link
  to link, so this is the least arithmetic and the fastest code; compile time grows with the tree.
- `Rolled` is a `lax.scan` over the links: one step is compiled however many there are.
- `Limbs` writes out the trunk and one limb of each kind, and is a `lax.scan` over the limbs of that
  kind: a humanoid's two legs are one leg in a loop. For GPU threads, whose programs must be short.

`outward` hands each step its parent's carry, `inward` the sum of its children's messages.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from rbjax.dynamics.contract import Driver as Driver
from rbjax.dynamics.limbs import Limbs
from rbjax.dynamics.rolled import Rolled
from rbjax.dynamics.rolled import allocate_slots as allocate_slots
from rbjax.dynamics.unrolled import Unrolled
from rbjax.model import DRIVER_NAMES, Model, Prepared, partition, prepare

#: above this many velocity coordinates "auto" rolls. On the CPU unrolled code runs two to three
#: times as fast, but compiling its gradient takes 0.8 s a link, rolled 4 s whatever the length
#: (benchmarks/results/cpu-thresholds-*.json: chains of 4 to 16).
UNROLLED_UP_TO = 8

#: the same on the CPU for values of a model whose numbers are part of the program: a humanoid's
#: forward dynamics runs ten times as fast (alone, within a loop, 25 times) and compiles in 3 s
#: instead of 2; where the model is an argument it would be twice as fast and take 15 s
VALUES_UNROLLED_UP_TO = 40

#: the same in a GPU thread, by bytes of a number: up to some 8,000 statements fetching instructions
#: costs nothing; numbers of 8 bytes take two registers each. ABA has 350 statements a coordinate,
#: the others have 190 at most
THREADS_UNROLLED_UP_TO = {4: 26, 8: 12}
SHORT_UNROLLED_UP_TO = {4: 42, 8: 20}

#: above this many velocity coordinates what has a row of numbers for each pair of links runs as
#: several kernels, a thread for each link of each sample
THREADS_APART_ABOVE = 8

DRIVERS: dict[str, Callable[[Model, Prepared], Driver]] = dict(
    zip(DRIVER_NAMES[1:], (Unrolled, Rolled, Limbs), strict=True)
)


def driver(model: Model, dtype: Any, *, values: bool = False) -> Driver:
    """The driver that the model asks for; "auto" unrolls small trees and rolls large ones.
    `values`: the model's numbers are known while tracing, and nobody differentiates what runs."""
    name = model.driver
    if name == "auto":
        few = values and jax.default_backend() == "cpu"
        most = VALUES_UNROLLED_UP_TO if few else UNROLLED_UP_TO
        name = "unrolled" if model.nv <= most else "rolled"
    if not model.nv or (name == "limbs" and not partition(model.topology).groups):
        name = "unrolled"
    return DRIVERS[name](model, prepare(model, dtype))


def on_threads(model: Model, dtype: Any, *, pairs: bool = False, long: bool = True) -> Model:
    """The model with the driver that suits a GPU thread, where it asks for none. `pairs`: what runs
    works on all pairs of links, which no limb shortens. `long`: it has as many statements as ABA,
    twice those of the others."""
    if model.driver != "auto":
        return model
    most = THREADS_UNROLLED_UP_TO if pairs or long else SHORT_UNROLLED_UP_TO
    few = model.nv <= most[np.dtype(dtype).itemsize]
    return model.replace(driver="unrolled" if few else "rolled" if pairs else "limbs")
