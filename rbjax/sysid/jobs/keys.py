"""The keys of a job file: the meaning and the valid values of each.

`docs/job_files.md` has the same tables; a test compares the two.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from rbjax.errors import InputError, UnknownName
from rbjax.sysid.data.units import TIME, UNITS

#: characters of a value that a message repeats
SHOWN = 60


class Key(NamedTuple):
    """A key of a table.

    kind: of its value, a name of `KINDS`.
    default: "" if the key is needed, or has no value if it is left out.
    unit: of its value.
    means: its meaning.
    """

    kind: str
    default: str
    unit: str
    means: str


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

OF_IDENTIFY = "the default of `identify`"
#: table -> key -> `Key`; "" is the head of the file; each line of "columns" and "unknowns" has keys
KEYS: dict[str, dict[str, Key]] = {
    "": {
        "model": Key("text", "", "", "MJCF or URDF file, or the name of a bundled scene"),
        "floating_base": Key(
            "yes", "false, with a warning if the root has a mass", "",
            "whether a URDF's root link is free",
        ),
        "friction": Key("yes", "false", "", "whether the file's friction loss is simulated"),
        "limits": Key("yes", "false", "", "whether the file's joint limits are simulated"),
        "motors": Key("yes", "false", "", "whether joints without an actuator get a motor"),
    },
    "recordings": {
        "fit": Key("texts", "", "", "csv, txt or npz files that are fitted"),
        "held_out": Key("texts", "none", "", "files that are not fitted, for the verdict"),
        "time": Key("text", '"t"', "", "name of the column, or array, with the clock"),
        "time_unit": Key("unit", '"s"', "", "unit of the clock: s, ms, us, ns or min"),
        "rate": Key("positive", "", "Hz", "sampling rate, if the files have no clock"),
        "delimiter": Key("character", "detected", "", "between the cells of csv and txt files"),
        "decimal": Key("decimal", '"."', "", "decimal mark of csv and txt files"),
        "comment": Key("character", '"#"', "", "first character of lines that are skipped"),
    },
    "columns": {
        "sensor": Key("text", "", "", "what is measured: a sensor of the table above"),
        "joint": Key("texts", "the column's name", "", "the joint, or for `ctrl` the actuator; a "
                     "list for an array with several columns, or the name of an array that holds "
                     "the names"),
        "unit": Key("unit", '""', "", "unit of the numbers in the file; SI if empty"),
        "scale": Key("factor", "1", "", "a further factor: a gear ratio, a torque constant"),
        "sign": Key("sign", "1", "", "-1 if the sensor has the opposite positive direction"),
        "noise": Key("positive", "estimated", "SI", "standard deviation; for all columns of a "
                     "sensor or for none"),
        "time": Key("text", "the time column of [recordings]", "", "the column's own clock"),
    },
    "unknowns": {
        "leaf": Key("text", "", "", 'array of the set-up, such as "bodies.mass"'),
        "index": Key("index", "all", "", "entries of the leaf: integers from 0, or names"),
        "positive": Key("yes", "false", "", "whether the numbers are above 0"),
        "bounds": Key("bounds", "none", "SI", "[low, high], neither of which is reached"),
        "scale": Key("positive", "1", "SI", "a large change of numbers that are neither "
                     "positive nor bounded"),
        "inertia": Key("text", "", "", "instead of leaf: the body whose ten inertial parameters "
                       "are estimated"),
        "tilt": Key("true", "", "", "instead of leaf: the direction of gravity is estimated"),
    },
    "controller": {
        "kp": Key("numbers", "0", "N m/rad", "ctrl = kp (command - q) - kd v; one, or one for each "
                  "actuator"),
        "kd": Key("numbers", "0", "N m s/rad", "as kp"),
        "delay": Key("not negative", "none", "s", "from a command to its action; can be unknown"),
        "longest_delay": Key("positive", "3 delays", "s", "upper limit of an unknown delay"),
    },
    "sensors": {
        "current": Key("positives", "", "N m/A", "torque constant at each joint, if `current` is a "
                       "sensor"),
    },
    "options": {
        "starts": Key("yes", OF_IDENTIFY, "", "whether initial states are estimated"),
        "pieces": Key("positive", "none", "s", "length of pieces that are fitted first"),
        "shooting": Key("positive", "none", "s", "length of the segments of multiple shooting, for "
                        "a long or chaotic motion"),
        "many_starts": Key("count", "none", "", "number of first guesses of `many_starts`"),
        "restarts": Key("integer", OF_IDENTIFY, "", "largest number of other starts, if the fit is "
                        "poor"),
        "loss": Key("loss", OF_IDENTIFY, "", '"huber" reduces the weight of outliers'),
        "steps": Key("count", OF_IDENTIFY, "", "largest number of evaluations of the residual, of "
                     "each fit"),
        "period": Key("positive", "the finest clock", "s", "time for which a command is held"),
        "substeps": Key("count", "by a check", "", "steps of integration in a period; the check "
                        "halves them until the numbers do not change"),
    },
    "output": {
        "folder": Key("text", "the file's name", "", "within the file's folder, for the results"),
    },
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
    """`InputError` or `UnknownName` unless the tables and keys are those of `KEYS`, and each value
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
            raise InputError(f"identify: {table} is {short(inside)}, expected a table [{table}]")
        if table not in ("columns", "unknowns"):
            _values(table, inside, f"[{table}]")
            continue
        for name, line in inside.items():
            if not _text(name):
                raise InputError(f"identify: [{table}] has the name {short(name)}, expected a text")
            if not isinstance(line, dict):
                raise InputError(
                    f"identify: [{table}] {name} is {short(line)}, expected {NEEDED[table]}"
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
        fits, expected = KINDS[KEYS[table][key].kind]
        if not fits(value):
            if key == "held_out" and value == []:
                continue
            if key == "fit" and value == []:
                continue  # named as missing
            at = f"{where} {key}".strip()
            raise InputError(f"identify: {at} is {short(value)}, expected {expected}")
        if KEYS[table][key].kind == "unit" and value not in UNITS:
            raise UnknownName(f"unit of {where}", value, UNITS)


def short(value: Any) -> str:
    """A value for a message."""
    if isinstance(value, int) and abs(value) > 10**SHOWN:
        return f"an integer of {int(math.log10(abs(value))) + 1} digits"
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."
