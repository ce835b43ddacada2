"""Bad arguments of planning, wheeled, constraints, stability and solvers: a sentence of rbjax, or a
finite result."""

from __future__ import annotations

import functools
import random
import traceback
import warnings
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
import pytest

import rbjax as rb
from tests.rooms import ROOMS

SEED = 11


pendulum = functools.cache(lambda: rb.load("pendulum"))


def bad_values(good: Any) -> Iterator[tuple[str, Any]]:
    """Values of the wrong type, shape or size, by what they are."""
    yield "an object", object()
    yield "a word", "fast"
    yield "a dict", {"a": 1}
    yield "a function of nothing", lambda: 0.0
    yield "a model", pendulum()
    if good is None or isinstance(good, str | bool) or callable(good):
        yield "a number", 3.7
        return
    if isinstance(good, int):
        yield from {"negative": -3, "zero": 0, "half": 2.5, "nan": np.nan, "list": [2]}.items()
        return
    try:
        array = np.asarray(good)
    except Exception:
        return
    if array.dtype.kind not in "fib" or array.dtype.kind == "b":
        return
    array = array.astype(float)
    yield "nan", np.full(array.shape, np.nan) if array.ndim else float("nan")
    yield "complex", array + 1j
    yield "an axis more", np.stack([array, array])[..., None]
    if array.ndim:
        yield "empty", np.zeros((0, *array.shape[1:]))
        yield "one more", np.concatenate([array, array[-1:]])
        yield "ragged", [[1.0], [1.0, 2.0]]
    else:
        yield "negative", -abs(float(array)) - 1.0
        yield "inf", -np.inf
        yield "a list", [1.0, 2.0, 3.0, 4.0, 5.0]


#: functions of complex numbers
COMPLEX = ("growth_factors",)


def cases() -> list[tuple[str, str, str, str, Any]]:
    return [
        (f"{door}({name}: {what})", door, room, name, bad)
        for room, doors in ROOMS.items()
        for door, (_, given) in doors.items()
        for name, good in given.items()
        for what, bad in bad_values(good)
    ]


def wrong_with(room: str, door: str, name: str, bad: Any) -> str | None:
    function, given = ROOMS[room][door]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            got = function(**given | {name: bad})
            leaves = [np.asarray(x) for x in jax.tree.leaves(got) if hasattr(x, "dtype")]
    except rb.RbjaxError as error:
        return None if len(str(error)) > 30 else f"says only {str(error)!r}"
    except Exception as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        where = f"{last.filename[-40:]}:{last.lineno}"
        return f"{type(error).__name__}: {str(error)[:120]!r} at {where}"
    for x in leaves:
        if x.dtype.kind in "fc" and np.isnan(x).any():
            return "gives nan"
        if x.dtype.kind in "cO" and door not in COMPLEX:
            return f"gives {x.dtype}"
    return None


@pytest.mark.parametrize("count", [60, pytest.param(None, marks=pytest.mark.slow)])
def test_bad_arguments_end_in_a_sentence_or_in_a_finite_result(count: int | None) -> None:
    every = cases()
    assert len(every) > 900
    drawn = random.Random(SEED).sample(every, count or len(every))
    found = {what: wrong_with(room, door, name, bad) for what, door, room, name, bad in drawn}
    wrong = [f"{what}: {how}" for what, how in found.items() if how]
    assert not wrong, "\n".join(["", *wrong])
