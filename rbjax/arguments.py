"""Conversion and check of arguments that are numbers on the host, outside of traced code."""

from __future__ import annotations

import math
from collections.abc import Collection
from typing import Any

import numpy as np

from rbjax.errors import InputError, UnknownName


def real_array(
    where: str, name: str, value: Any, *, ndim: int | None = None, finite: bool = True
) -> np.ndarray:
    """A float64 array.

    Args:
        where: the function, for the message.
        name: the argument, for the message.
        value: what the user gave.
        ndim: the number of axes, if it is fixed.
        finite: whether NaN and infinity are rejected.

    Raises:
        InputError: not real numbers; another number of axes; values that are not finite.
    """
    try:
        found = np.asarray(value)
        known = found.dtype.kind in "biuf"
        x = found.astype(np.float64) if known else np.zeros(0)
    except (TypeError, ValueError, OverflowError):
        known = False
    if not known:
        raise InputError(f"{where}: {name} is {_shown(value)}, expected real numbers")
    if ndim is not None and x.ndim != ndim:
        raise InputError(f"{where}: {name} has shape {x.shape}, expected {ndim} axes")
    if finite and not np.isfinite(x).all():
        at = tuple(map(int, np.argwhere(~np.isfinite(x))[0]))
        place = f"{name}{list(at)}" if at else name
        raise InputError(f"{where}: {place} is {x[at]}, expected finite numbers")
    return x


def real_number(
    where: str,
    name: str,
    value: Any,
    *,
    above: float = -math.inf,
    least: float = -math.inf,
    finite: bool = True,
) -> float:
    """A float.

    Args:
        where: the function, for the message.
        name: the argument, for the message.
        value: what the user gave.
        above: the value must be larger.
        least: the value must be at least this.
        finite: whether infinity is rejected. NaN always is.

    Raises:
        InputError: not a real number, or out of range.
    """
    x = real_array(where, name, value, finite=False)
    limit = f" above {above:g}".replace("above 0", "above zero") if above > -math.inf else ""
    limit += f" of at least {least:g}" if least > -math.inf else ""
    if x.shape != ():
        raise InputError(f"{where}: {name} has shape {x.shape}, expected a number{limit}")
    number = float(x)
    if math.isnan(number) or (finite and math.isinf(number)):
        raise InputError(f"{where}: {name} is {number}, expected a finite number{limit}")
    if not (number > above or above == -math.inf) or number < least:
        raise InputError(f"{where}: {name} is {number}, expected a number{limit}")
    return number


def integer(where: str, name: str, value: Any, *, least: int | None = None) -> int:
    """An int.

    Raises:
        InputError: not an integer, less than `least`, or more than floats count exactly.
    """
    known = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if known and abs(value) > 2**53:
        raise InputError(f"{where}: {name} is {_shown(value)}, expected at most 2**53")
    if not known or (least is not None and value < least):
        limit = "" if least is None else f" of at least {least}"
        raise InputError(f"{where}: {name} is {_shown(value)}, expected an integer{limit}")
    return int(value)


def flag(where: str, name: str, value: Any) -> bool:
    """True or False.

    Raises:
        InputError: anything else.
    """
    if not isinstance(value, (bool, np.bool_)):
        raise InputError(f"{where}: {name} is {_shown(value)}, expected True or False")
    return bool(value)


def choice(kind: str, name: Any, known: Collection[str]) -> str:
    """A name among those that are known.

    Raises:
        UnknownName: another name, or not a string.
    """
    if not isinstance(name, str) or name not in known:
        raise UnknownName(kind, name, known)
    return name


def _shown(value: Any) -> str:
    """A value for a message, or its type if it is long."""
    text = repr(value)
    return text if len(text) <= 60 else f"{type(value).__name__} {text[:50]}..."
