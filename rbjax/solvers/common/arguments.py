"""Checks of the arguments that a solver is constructed with."""

from __future__ import annotations

from typing import Any

import diffrax
import jax
import numpy as np

from rbjax.errors import InputError


def check_whole(
    where: str, what: str, value: Any, low: int, high: int | None = None, why: str = ""
) -> None:
    """`InputError` unless value is a whole number from low to high, or from low on."""
    whole = isinstance(value, (int, np.integer)) and not isinstance(value, bool)
    if not (whole and low <= value and (high is None or value <= high)):
        among = f"of at least {low}" if high is None else f"from {low} to {high}"
        raise InputError(f"{where}: {what} = {value!r}, expected a whole number {among}{why}")


def check_between(solver: str, what: str, value: Any, low: float, high: float) -> None:
    """`InputError` unless value is from low to high. A traced value is not checked."""
    if isinstance(value, jax.core.Tracer):
        return
    numbers = np.asarray(value) if not isinstance(value, (list, tuple)) else np.array("a list")
    if numbers.dtype.kind not in "biuf":
        got = f"{value!r} of {type(value).__name__}"
        raise InputError(f"{solver}: {what} = {got}, expected a number from {low} to {high}")
    if not ((low <= numbers) & (numbers <= high)).all():
        raise InputError(f"{solver}: {what} = {value}, expected a number from {low} to {high}")


def check_solver(function: str, solver: Any) -> None:
    """`InputError` unless solver is an instance of a diffrax solver."""
    if isinstance(solver, diffrax.AbstractSolver):
        return
    got, fix = repr(solver), ""
    if isinstance(solver, str):
        fix = f": rb.solvers.all()[{solver!r}].make()"
    elif hasattr(solver, "make"):
        fix = ": the entry's make()"
    elif hasattr(solver, "__name__"):
        got = f"the {'class' if isinstance(solver, type) else 'function'} {solver.__name__}"
        fix = f": {solver.__name__}()"
    raise InputError(f"{function}: solver is {got}, expected a solver of diffrax{fix}")
