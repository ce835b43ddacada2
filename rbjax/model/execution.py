"""How algorithms run on a model. Nothing here changes what they compute."""

from __future__ import annotations

import dataclasses
from typing import Any

import equinox as eqx

from rbjax.errors import UnknownName
from rbjax.model.record import Record

#: how the recursions can run; `rbjax.dynamics.drivers.choice` chooses where it is "auto"
DRIVER_NAMES = ("auto", "unrolled", "rolled", "limbs")


class Execution(Record):
    """The driver of the recursions, and what programs know of a model's numbers.

    Fields:
        driver: one of `DRIVER_NAMES`.
        zeros: the entries of leaves that are part of the program (`Model.fix_zeros`), or None.
        constants: the link constants, if they were computed before a loop (`with_constants`).
    """

    driver: str = eqx.field(static=True, default="auto")
    zeros: tuple | None = eqx.field(static=True, default=None)
    constants: Any = None

    def __check_init__(self) -> None:
        if self.driver not in DRIVER_NAMES:
            raise UnknownName("driver", self.driver, DRIVER_NAMES)


#: the names of its fields
EXECUTION = tuple(f.name for f in dataclasses.fields(Execution))
