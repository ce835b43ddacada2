"""The keys of a job file, and the kinds of their values."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from rbjax.errors import InputError, UnknownName
from rbjax.sysid.data.units import TIME, UNITS

#: the largest number of characters of a value in a message
SHOWN = 60


def _number(x: Any) -> bool:
    return isinstance(x, (int, float)) and not isinstance(x, bool) and abs(x) < 1e300


def _text(x: Any) -> bool:
    return isinstance(x, str) and bool(x.strip()) and x.isprintable() and len(x) < 1000


def _list(each: Callable[[Any], bool]) -> Callable[[Any], bool]:
    return lambda x: isinstance(x, list) and bool(x) and all(map(each, x))


def _count(x: Any) -> bool:
    return isinstance(x, int) and not isinstance(x, bool) and 1 <= x < 10**9


def _whole(x: Any) -> bool:
    return _count(x) or (isinstance(x, int) and not isinstance(x, bool) and x == 0)


def _index(x: Any) -> bool:
    place = isinstance(x, int) and not isinstance(x, bool) and abs(x) < 2**31
    return place or _text(x) or _list(_index)(x)


def _bounds(x: Any) -> bool:
    numbers = isinstance(x, list) and len(x) == 2 and all(isinstance(i, (int, float)) for i in x)
    return numbers and not any(isinstance(i, bool) for i in x) and x[0] < x[1]


#: kind of a value -> whether a value is one, and what is expected
KINDS: dict[str, tuple[Callable[[Any], bool], str]] = {
    "text": (_text, 'a text in quotes, such as "q"'),
    "texts": (lambda x: _text(x) or _list(_text)(x), "a text in quotes, or a list of them"),
    "number": (_number, "a finite number"),
    "factor": (lambda x: _number(x) and x != 0, "a finite number other than 0"),
    "positive": (lambda x: _number(x) and x > 0, "a finite number above 0"),
    "not negative": (lambda x: _number(x) and x >= 0, "a finite number, 0 or more"),
    "numbers": (lambda x: _number(x) or _list(_number)(x), "a finite number, or a list of them"),
    "positives": (
        lambda x: all(_number(i) and i > 0 for i in (x if isinstance(x, list) and x else [x])),
        "a finite number above 0, or a list of them",
    ),
    "count": (_count, "an integer, 1 or more"),
    "integer": (_whole, "an integer, 0 or more"),
    "yes": (lambda x: isinstance(x, bool), "true or false"),
    "true": (lambda x: x is True, "true"),
    "sign": (lambda x: _number(x) and x in (1, -1), "1 or -1"),
    "unit": (lambda x: isinstance(x, str), 'a unit in quotes, such as "deg"'),
    "index": (_index, "an integer, a name in quotes, or a list of them"),
    "bounds": (_bounds, "two numbers [low, high], low below high; -inf and inf for no bound"),
    "loss": (lambda x: x in ("squares", "huber"), '"squares" or "huber"'),
    "decimal": (lambda x: x in (".", ","), '"." or ","'),
    "character": (lambda x: isinstance(x, str) and len(x) == 1, "one character in quotes"),
}

#: table -> key -> kind of its value. "" is the head of the file; each line of "columns" and of
#: "unknowns" has keys. `docs/job_files.md` has units, defaults and meanings.
KEYS: dict[str, dict[str, str]] = {
    "": {
        "model": "text", "floating_base": "yes", "friction": "yes", "limits": "yes",
        "motors": "yes",
    },
    "recordings": {
        "fit": "texts", "held_out": "texts", "time": "text", "time_unit": "unit",
        "rate": "positive", "delimiter": "character", "decimal": "decimal", "comment": "character",
    },
    "columns": {
        "sensor": "text", "joint": "texts", "unit": "unit", "scale": "factor", "sign": "sign",
        "noise": "positive", "time": "text",
    },
    "unknowns": {
        "leaf": "text", "index": "index", "positive": "yes", "bounds": "bounds",
        "scale": "positive", "inertia": "text", "tilt": "true",
    },
    "controller": {
        "kp": "numbers", "kd": "numbers", "delay": "not negative", "longest_delay": "positive",
    },
    "sensors": {"current": "positives"},
    "options": {
        "estimate_initial_state": "yes", "segments": "positive", "multiple_shooting": "positive",
        "many_starts": "count", "restarts": "integer", "loss": "loss", "max_evaluations": "count",
        "period": "positive", "substeps": "count",
    },
    "output": {"folder": "text"},
}  # fmt: skip
#: needed tables and keys -> an example
NEEDED = {
    "model": 'model = "robot.xml"',
    "recordings": '[recordings] with fit = ["run.csv"]',
    "columns": '[columns] with lines such as "elbow angle" = {sensor = "q", joint = "elbow"}',
    "unknowns": '[unknowns] with lines such as damping = {leaf = "joints.damping"}, each with one '
    "of leaf, inertia and tilt",
}


def check(given: Mapping[str, Any]) -> None:
    """Raise `InputError` or `UnknownName` unless the tables and keys are in `KEYS`, and each value
    is of its kind."""
    heads, tables = KEYS[""], [table for table in KEYS if table]
    for key in given:
        if key not in heads and key not in tables:
            raise UnknownName("key of the configuration", key, [*heads, *tables])
    for key, example in NEEDED.items():
        if key not in given or given[key] == {}:
            raise InputError(f"identify: the configuration has no {key}, expected {example}")
    _values("", {k: v for k, v in given.items() if k in heads}, "")
    for table in tables:
        inside = given.get(table, {})
        if not isinstance(inside, dict):
            raise InputError(f"identify: {table} is {shorten(inside)}, expected a table [{table}]")
        if table not in ("columns", "unknowns"):
            _values(table, inside, f"[{table}]")
            continue
        for name, line in inside.items():
            if not _text(name):
                raise InputError(
                    f"identify: [{table}] has the name {shorten(name)}, expected a text"
                )
            if not isinstance(line, dict):
                raise InputError(
                    f"identify: [{table}] {name} is {shorten(line)}, expected {NEEDED[table]}"
                )
            _values(table, line, f"[{table}] {name}")
    if not given["recordings"].get("fit"):
        raise InputError(f"identify: [recordings] has no fit, expected {NEEDED['recordings']}")
    unit = given["recordings"].get("time_unit", "s")
    if unit not in TIME:
        raise UnknownName("unit of time", unit, TIME)


def _values(table: str, given: Mapping[str, Any], where: str) -> None:
    for key, value in given.items():
        if key not in KEYS[table]:
            raise UnknownName(f"key of {where or 'the configuration'}", key, KEYS[table])
        fits, expected = KINDS[KEYS[table][key]]
        if not fits(value):
            if key in ("held_out", "fit") and value == []:  # `check` names a missing fit
                continue
            at = f"{where} {key}".strip()
            raise InputError(f"identify: {at} is {shorten(value)}, expected {expected}")
        if KEYS[table][key] == "unit" and value not in UNITS:
            raise UnknownName(f"unit of {where}", value, UNITS)


def shorten(value: Any) -> str:
    """Shorten a value for a message."""
    if isinstance(value, int) and abs(value) > 10**SHOWN:
        return f"an integer of {int(math.log10(abs(value))) + 1} digits"
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."
