"""Checks of single arguments: numbers, integers, arrays of numbers, objects of a kind."""

from __future__ import annotations

import math
from typing import Any

import jax
import numpy as np

from rbjax.errors import InputError


def check_real(
    where: str, name: str, x: Any, expected: str, *, above: float = -math.inf,
    least: float = -math.inf,
) -> None:  # fmt: skip
    """`InputError` unless x is a finite real number within the bounds. Traced values pass."""
    if isinstance(x, jax.core.Tracer) and x.shape == ():
        return
    try:
        value = np.asarray(x)
        good = value.ndim == 0 and value.dtype.kind in "iuf" and math.isfinite(value)
        good = bool(good and above < value and least <= value)
    except (TypeError, ValueError, OverflowError, RuntimeError):
        good = False
    if not good:
        raise InputError(f"{where}: {name} is {shown(x)}, expected {expected}")


def check_integer(where: str, name: str, x: Any, least: int = 1) -> None:
    """`InputError` unless x is an integer of at least `least`."""
    if isinstance(x, bool) or not isinstance(x, int | np.integer) or x < least:
        expected = {1: "a positive integer"}.get(least, f"an integer of at least {least}")
        raise InputError(f"{where}: {name} is {shown(x)}, expected {expected}")


def check_kind(where: str, name: str, x: Any, kind: type, public: str) -> None:
    """`InputError` unless x is an instance of a class, whose public name is given."""
    if not isinstance(x, kind):
        raise InputError(f"{where}: {name} is {shown(x)}, expected {public}")


def array_of(
    where: str, name: str, x: Any, expected: str, dtype: type = float, *, finite: bool = True
) -> np.ndarray:
    """x as an array of NumPy, of finite numbers if `finite`, or an `InputError`."""
    out: np.ndarray | None
    try:
        given = np.asarray(x)
        known = given.dtype.kind in ("biufc" if dtype is complex else "biuf") or not given.size
        out = np.asarray(given, dtype) if known else None
    except (TypeError, ValueError):
        out = None
    bad = out is None or (finite and not np.isfinite(out).all())
    if bad or out is None:
        raise InputError(f"{where}: {name} is {shown(x)}, expected {expected}")
    return out


def shown(x: Any) -> str:
    """A value for a message, of at most 60 characters; its type if it has no short text."""
    text = repr(x) if isinstance(x, str | int | float | complex | list | tuple | np.ndarray) else ""
    return text if 0 < len(text) <= 60 else f"of type {type(x).__name__}"
