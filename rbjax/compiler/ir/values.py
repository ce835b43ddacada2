"""The values of a program: variables, and numbers that are known while it is written."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

BOOL: np.dtype = np.dtype(bool)
I32: np.dtype = np.dtype(np.int32)
I64: np.dtype = np.dtype(np.int64)
F64: np.dtype = np.dtype(np.float64)


class Unsupported(Exception):
    """A primitive, an operation or a type that the compiler does not support."""


@dataclass(frozen=True, slots=True, eq=False)
class Var:
    """A scalar that is computed when the program runs."""

    id: int
    dtype: np.dtype


Value = Var | np.generic


def is_number(x: Value, number: int) -> bool:
    """Whether a value is known to be this number."""
    return isinstance(x, np.generic) and x.dtype != BOOL and x == number
