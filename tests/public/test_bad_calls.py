"""Random bad arguments of every public function: an error of rbjax that names the argument, or a
finite result of the right shapes. Never an error from inside, never a NaN that nobody mentions."""

from __future__ import annotations

import functools
import inspect
import random
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb

SEED = 11
ROOM_NAMES = ("body", "constraints", "contact", "envs", "estimation", "flexible", "loading",
              "planning", "plotting", "rotations", "sensors", "solvers", "spatial", "stability",
              "wheeled", "viewer", "envs.adapters", "envs.learning", "flexible.modal",
              "older", "envs.terms")  # fmt: skip
#: functions whose accepted calls compile for more than a second
HEAVY = {"clear_along", "drift", "equilibrium", "gradient_growth", "grid_a_star", "grid_dijkstra",
         "hybrid_a_star", "lyapunov", "plan", "reduced_linearisation", "refine", "rollout",
         "simulate", "smooth", "time_scaling", "tracking_gains", "recommend", "validation",
         "motion_of", "motion_of_policy", "animate_policy", "record_policy",
         "evaluate"}  # fmt: skip
WORD = "fast"


def of_arrays(good: np.ndarray) -> dict[str, Any]:
    """Bad values for an array."""
    ones = np.ones(good.shape)
    bad: dict[str, Any] = {
        "a word": WORD, "None": None, "text": np.full(good.shape, "a"), "a dict": {"q": 0.0},
        "a function": lambda: ones, "ragged": [[1.0], [1.0, 2.0]], "bytes": b"fast",
        "objects": np.full(good.shape, None, object), "complex": good * (1 + 1j),
        "a model": rb.Model, "an axis more": np.ones((*good.shape, 1, 7)),
    }  # fmt: skip
    if good.dtype.kind == "f" and good.size:
        for value in (np.nan, np.inf):
            spoilt = np.array(good)
            spoilt.flat[0] = value
            bad[str(value)] = spoilt
    if good.ndim:
        bad |= {
            "one more": np.ones((*good.shape[:-1], good.shape[-1] + 1)), "a number": 1.0,
            "none": np.zeros((*good.shape[:-1], 0)), "an empty list": [],
        }  # fmt: skip
    return bad


NUMBERS = {
    "a word": WORD, "None": None, "nan": np.nan, "inf": np.inf, "complex": 1j, "a dict": {},
    "a list": [0.1, 0.2], "an array": np.ones((2, 2)), "a function": len, "objects": object(),
    "negative": -1.0, "zero": 0.0, "huge": 10**400, "bytes": b"1",
}  # fmt: skip
COUNTS = {**NUMBERS, "half": 2.5, "negative": -3}
NAMES = {"misspelt": "reducedd", "a number": 3, "None": None, "a list": ["a"], "empty": "",
         "a dict": {}, "an array": np.zeros(2), "bytes": b"planar"}  # fmt: skip
FLAGS = {"a word": WORD, "a number": 7, "None": None, "an array": np.ones(2)}
RECORDS = {
    "None": None, "a word": WORD, "a number": 3.0, "a dict": {}, "an array": np.ones(3),
    "a class": rb.Model, "a state": rb.State(jnp.zeros(9), jnp.zeros(9)), "a list": [1, 2],
    "a function": len,
}  # fmt: skip
FUNCTIONS = {k: x for k, x in RECORDS.items() if k not in ("a class", "a function")}
PATHS = {"None": None, "a number": 3, "a dict": {}, "an array": np.zeros(2), "a list": [],
         "no such folder": Path("/dev/null/a.npz"), "a function": len}  # fmt: skip
STATES = {
    "words": rb.State("a", "b"), "nothing": rb.State(None, None),
    "other sizes": rb.State(jnp.zeros(9), jnp.zeros(11)), "nan": None,
}  # fmt: skip


def bad_values(good: Any) -> dict[str, Any]:
    if isinstance(good, bool):
        return FLAGS
    if isinstance(good, int):
        return COUNTS
    if isinstance(good, float):
        return NUMBERS
    if isinstance(good, str):
        return NAMES
    if isinstance(good, jax.Array) and jnp.issubdtype(good.dtype, jax.dtypes.prng_key):
        return RECORDS
    if inspect.isfunction(good):
        return FUNCTIONS
    if isinstance(good, (np.ndarray, jax.Array)):
        return of_arrays(np.asarray(good))
    if type(good) is tuple and all(isinstance(x, (int, float)) for x in good):
        return of_arrays(np.asarray(good, float))
    if isinstance(good, Path):
        return PATHS
    if isinstance(good, rb.State):
        nan = jax.tree.map(lambda x: x * np.nan, good)
        return {**RECORDS, **STATES, "nan": nan}
    return RECORDS


#: what a message says of parts of an argument
OTHER_NAMES = {"state": (" q", " v"), "states": (" q", " v"), "y": (" q ", " p "),
               "method": ("solver",), "y0": (" q", " v", "state"),
               "source": ("regular file", "scene", "representation"),
               "solver": ("Compensated",), "start": ("the state",), "given": ("inputs",),
               "ahead": ("length",), "behind": ("length",), "parts": ("part",),
               "target": ("representation", "position"), "joint": ("joint",), "parent": ("body",),
               "frame": ("site",), "reference": ("site", "a frame"), "seen": ("site", "a frame"),
               "root": ("joint",), "xml": ("geom 'floor'",), "low": ("(low, high)", "high is"),
               "high": ("(low, high)",), "path": ("folder", "file"), "tracked": ("body",),
               "formula_order": ("order",), "Q": (" P ",),
               "trace": ("body",), "what": ("file, scene", "source", "regular file"),
               "B": (" K ", " R "),
               "joint_terms": ("joint term",), "command": ("variable of the task",),
               "home": ("joint",)}  # fmt: skip
#: arguments whose other shapes are right too: several samples, another number of points or steps
ANY_SHAPE = ("z", "h_omega", "ctrl", "lag", "friction", "x", "y", "max_steps", "transient",
             "wrenches", "points", "positions", "rates", "poses", "path",
             "coefficients", "hidden", "std", "seconds", "shape", "guess", "joint_terms",
             "B", "ax")  # fmt: skip

#: arguments that may be infinite
ENDLESS = ("battery", "friction", "limit", "speed", "turn_rate", "steering_rate")


def heavy(what: str) -> bool:
    return not HEAVY.isdisjoint(what.partition("(")[0].split("."))


Case = tuple[str, str, Callable[[], Any], Callable[[], Any]]


def calls_of(room: str) -> Iterator[tuple[str, Callable, dict[str, Any]]]:
    """Name, function and good arguments of each call."""
    from tests.public.calls import ROOMS, function_of  # builds robots, grids and motions

    for name, given in ROOMS[room][1].items():
        yield name, function_of(room, name), given


def cases(room: str) -> Iterator[Case]:
    """What it is, the argument, the good call, the bad call."""
    for name, function, given in calls_of(room):
        good = functools.partial(function, **given)
        for argument, value in given.items():
            for kind, bad in bad_values(value).items():
                call = functools.partial(function, **{**given, argument: bad})
                yield f"{room}.{name}({argument}: {kind})", argument, good, call


def wrong_with(argument: str, call: Callable, good: Callable) -> str | None:
    """The problem with a bad call, or None."""
    try:
        got = call()
    except rb.RbjaxError as error:
        text = str(error)
        if len(text) < 25 or len(text) > 1500:
            return f"the message is {text[:80]!r}"
        names = {argument, *OTHER_NAMES.get(argument, ())}
        named = any(name.lower() in text.lower() for name in names)
        return None if named else f"does not name the argument: {text[:200]!r}"
    except Exception as error:
        return f"{type(error).__name__}: {str(error)[:150]}"
    if argument in ANY_SHAPE and (finite(got) or not finite(good())):
        return None
    return wrong_with_result(argument, got, good)


def numeric(tree: Any) -> list[np.ndarray]:
    leaves = jax.tree.leaves(eqx.filter(tree, eqx.is_array_like))
    return [np.asarray(x) for x in leaves]


def finite(tree: Any) -> bool:
    return all(np.isfinite(x).all() for x in numeric(tree) if x.dtype.kind == "f")


def wrong_with_result(argument: str, got: Any, good: Callable) -> str | None:
    """A result that is not finite if that of the good call is, or of other shapes but for leading
    axes of a batch."""
    if isinstance(got, rb.Trajectory) and not np.all(got.success):
        return None
    want = good()
    due, shapes = ([x.shape for x in numeric(tree)] for tree in (want, got))
    if not finite(got) and finite(want) and argument not in ENDLESS:
        return f"gives {[x for x in numeric(got) if x.dtype.kind == 'f'][:2]} without a word"
    same = len(shapes) == len(due) and all(
        shape[len(shape) - len(d) :] == d for shape, d in zip(shapes, due, strict=True)
    )
    return None if same else f"accepted: shapes {shapes[:4]}, not {due[:4]}"


@pytest.mark.parametrize("count", [40, pytest.param(400, marks=pytest.mark.slow)])
@pytest.mark.parametrize("room", ROOM_NAMES)
def test_bad_arguments_are_named(room: str, count: int) -> None:
    quick = count == 40
    every = [c for c in cases(room) if not (quick and heavy(c[0]))]
    drawn = random.Random(SEED).sample(every, min(count, len(every)))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = {what: wrong_with(name, bad, good) for what, name, good, bad in drawn}
    wrong = [f"{what}: {how}" for what, how in found.items() if how]
    assert not wrong, "\n".join(["", *wrong])


@pytest.mark.slow
@pytest.mark.parametrize("room", ROOM_NAMES)
def test_the_good_calls_work(room: str) -> None:
    for _, function, given in calls_of(room):
        function(**given)
