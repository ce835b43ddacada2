"""The choice of a driver.

- `Unrolled` writes the steps of all links into the program. It uses the structural zeros of each
  link, so its code has the least arithmetic and is fastest. Compile time grows with the tree.
- `Rolled` is a `lax.scan` over the links, which compiles one step for any number of links.
- `Limbs` unrolls the trunk and one limb of each group, and is a `lax.scan` over the limbs of the
  group. It is for GPU threads, whose programs must be short.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbjax.compiler.jax.launch import has_gpu
from rbjax.dynamics.drivers.contract import Driver as Driver
from rbjax.dynamics.drivers.limbs import Limbs
from rbjax.dynamics.drivers.rolled import Rolled
from rbjax.dynamics.drivers.rolled import allocate_slots as allocate_slots
from rbjax.dynamics.drivers.unrolled import Unrolled
from rbjax.model import DRIVER_NAMES, Model, ModelConstants, partition, prepare

#: the largest number of velocity coordinates for which "auto" is "unrolled"; otherwise it is
#: "rolled". Unrolled code runs faster but compiles slower
#: (benchmarks/results/cpu-thresholds-*.json: chains of 4 to 16).
UNROLLED_UP_TO = 8

#: bytes of a number -> the largest number of velocity coordinates for which a GPU thread is
#: unrolled: instruction fetches are free up to about 8,000 statements. ABA has 350 statements for
#: each coordinate; short algorithms have 190 at most
THREADS_UNROLLED_UP_TO = {4: 26, 8: 12}
SHORT_UNROLLED_UP_TO = {4: 42, 8: 20}

#: the lower bound of these thresholds without a GPU, where unrolled code is faster than limbs
CPU_UNROLLED_UP_TO = 26

#: above this number of velocity coordinates, algorithms on pairs of links run as several kernels on
#: a GPU, with a thread for each link of each sample
KERNELS_ABOVE = 8

DRIVERS: dict[str, Callable[[Model, ModelConstants], Driver]] = dict(
    zip(DRIVER_NAMES[1:], (Unrolled, Rolled, Limbs), strict=True)
)


def driver(model: Model, dtype: Any) -> Driver:
    """Return the driver of a model. "auto" unrolls small trees and rolls large trees."""
    name = model.driver
    if name == "auto":
        name = "unrolled" if model.nv <= UNROLLED_UP_TO else "rolled"
    top = model.topology
    if top.frames and name == "rolled":
        name = "limbs"
    if not model.nv or (name == "limbs" and not partition(top).groups):
        name = "unrolled"
    return DRIVERS[name](model, prepare(model, dtype))


def on_threads(model: Model, dtype: Any, *, pairs: bool = False, long: bool = True) -> Model:
    """Replace the driver "auto" by one for a GPU thread or a SIMD lane.

    Args:
        pairs: True if the algorithm works on all pairs of links, which limbs do not shorten.
        long: True if the algorithm has as many statements for each link as ABA.
    """
    if model.driver != "auto":
        return model
    most = THREADS_UNROLLED_UP_TO if pairs or long else SHORT_UNROLLED_UP_TO
    few = model.nv <= max(most[np.dtype(dtype).itemsize], 0 if has_gpu() else CPU_UNROLLED_UP_TO)
    return model.replace(driver="unrolled" if few else "rolled" if pairs else "limbs")
