"""Checks of arguments that are common to several functions of identification."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from rbjax.arguments import choice, real_array, real_number, shown
from rbjax.dynamics.arguments import check_model
from rbjax.errors import InputError, listed
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.simulation.setup import Setup


def setup_of(where: str, model: Any) -> Setup:
    """Return a `Setup` unchanged, and convert a `Model` to a `Setup` with ideal sensors."""
    if isinstance(model, Setup):
        check_model(where, model.model)
        return model
    check_model(where, model)
    return Setup.of(model)


def recordings_of(where: str, recordings: Any, *, empty: bool = False) -> list[Recording]:
    """Convert one recording or several to a list, and check that their names are unique."""
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


def positive_numbers(where: str, name: str, given: Any, count: int, of: str) -> np.ndarray:
    """Convert one finite number above 0, or one for each of `count`, to (count,).

    of: what there are `count` of, such as "column", for the message.
    """
    x = real_array(where, name, given, "numbers above 0")
    if x.shape not in ((), (count,)) or not (x > 0).all():
        raise InputError(
            f"{where}: {name} is {shown(given)}, expected one number above 0, or {count}, one a "
            f"{of}"
        )
    return np.broadcast_to(x, (count,)).copy()


def check_options(
    where: str, loss: Any = "squares", estimate_initial_state: Any = None, **lengths: Any
) -> None:
    """Raise InputError unless the loss, the flag and the lengths are valid.

    lengths: by name, in s; None is valid.
    """
    choice(f"loss of {where}", loss, ("squares", "huber"))
    if not (estimate_initial_state is None or isinstance(estimate_initial_state, bool)):
        raise InputError(
            f"{where}: estimate_initial_state is {estimate_initial_state!r}, expected True, False "
            "or None"
        )
    for name, seconds in lengths.items():
        if seconds is not None:
            real_number(where, name, seconds, "seconds above 0", above=0.0)


def names_of(where: str, name: str, given: Any) -> tuple[str, ...]:
    """Convert an iterable of names to a tuple. A str becomes a tuple of its letters."""
    if not isinstance(given, Iterable) or not all(isinstance(x, str) for x in given):
        raise InputError(f"{where}: {name} is {shown(given)}, expected a list of names")
    return tuple(given)
