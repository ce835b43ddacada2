"""Checks of arguments that several functions of identification take."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from rbjax.arguments import instance, real_array, real_number, shown
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError, listed
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.simulation.setup import Setup


def setup_of(where: str, model: Any) -> Setup:
    """The set-up, or that of a model with ideal sensors."""
    if isinstance(model, Setup):
        check_model(where, model.model)
        return model
    check_model(where, model)
    return Setup.of(model)


def recordings_of(where: str, recordings: Any, *, empty: bool = False) -> list[Recording]:
    """One recording, or a sequence of them, as a list."""
    runs = [recordings] if isinstance(recordings, Recording) else recordings
    if not isinstance(runs, Sequence) or not all(isinstance(run, Recording) for run in runs):
        raise InputError(
            f"{where}: recordings is {type(recordings).__name__}, expected a Recording or a list "
            "of them"
        )
    if not (runs or empty):
        raise InputError(f"{where}: recordings is empty, expected one Recording or more")
    names = [run.name for run in runs]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise InputError(
            f"{where}: {len(names)} recordings, of which several are called {listed(twice, 4)}; "
            "expected a name for each, by which results tell them apart"
        )
    return list(runs)


def check_kind(where: str, name: str, value: Any, kind: type, fix: str) -> None:
    """`InputError` unless a value is of a kind; fix, where such a value comes from."""
    instance(where, name, value, kind, f"{kind.__name__}: {fix}")


def floats(where: str, name: str, x: Any, fix: str = "an array of numbers") -> np.ndarray:
    """x as an array of float64."""
    return real_array(where, name, x, fix, finite=False)


def check_how(
    where: str, loss: Any = "squares", starts: Any = None, *, pieces: Any = None,
    shooting: Any = None,
) -> None:  # fmt: skip
    """`InputError` for a loss, starts or lengths in s that a fit cannot have."""
    if not (isinstance(loss, str) and loss in ("squares", "huber")):
        raise InputError(f'{where}: loss is {loss!r}, expected "squares" or "huber"')
    if not (starts is None or isinstance(starts, bool)):
        raise InputError(f"{where}: starts is {starts!r}, expected True, False or None")
    for name, seconds in (("pieces", pieces), ("shooting", shooting)):
        if seconds is not None:
            check_seconds(where, name, seconds)


def check_seconds(where: str, name: str, seconds: Any) -> None:
    """`InputError` unless a length in s is a finite number above 0."""
    real_number(where, name, seconds, "seconds above 0", above=0.0)


def names_of(where: str, name: str, given: Any) -> tuple[str, ...]:
    """Names as a tuple; a str is its letters."""
    if not isinstance(given, Iterable) or not all(isinstance(x, str) for x in given):
        raise InputError(f"{where}: {name} is {shown(given)}, expected a list of names")
    return tuple(given)
