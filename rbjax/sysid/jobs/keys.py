"""Keys of a job file, and the names in it: joints of columns, indices of unknowns."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from rbjax.arguments import choice
from rbjax.errors import InputError, UnknownName
from rbjax.model import Model
from rbjax.sysid.data.readers import Column
from rbjax.sysid.data.recording import HELD, JOINT_SENSORS, Recording
from rbjax.sysid.data.units import MOVES, TIME, UNITS
from rbjax.sysid.parameters.unknowns import leaf_of
from rbjax.sysid.simulation.setup import Setup

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


#: kind of a value -> (check of a value, description of the expected value)
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
    "prior": (
        lambda x: _list(_number)(x) and len(x) == 2 and x[1] > 0,
        "two numbers [mean, standard deviation], the latter above 0",
    ),
    "loss": (lambda x: x in ("squares", "huber"), '"squares" or "huber"'),
    "decimal": (lambda x: x in (".", ","), '"." or ","'),
    "character": (lambda x: isinstance(x, str) and len(x) == 1, "one character in quotes"),
}

#: table -> key -> kind of the value. "" is the head of the file. The keys of "columns" and
#: "unknowns" are those of each line. `docs/guides/job_files.md` has units, defaults and meanings.
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
        "scale": "positive", "prior": "prior", "inertia": "text", "tilt": "true",
    },
    "controller": {
        "kp": "numbers", "kd": "numbers", "delay": "not negative", "longest_delay": "positive",
    },
    "sensors": {"current": "positives"},
    "options": {
        "estimate_initial_state": "yes", "segments": "positive", "multiple_shooting": "positive",
        "many_starts": "count", "restarts": "integer", "loss": "loss", "max_evaluations": "count",
        "difference_step": "positive", "period": "positive", "substeps": "count",
    },
    "output": {"folder": "text"},
}  # fmt: skip
#: required table or key -> an example
NEEDED = {
    "model": 'model = "robot.xml"',
    "recordings": '[recordings] with fit = ["run.csv"]',
    "columns": '[columns] with lines such as "elbow angle" = {sensor = "q", joint = "elbow"}',
    "unknowns": '[unknowns] with lines such as damping = {leaf = "joints.damping"}, each with one '
    "of leaf, inertia and tilt",
}


def check(given: Mapping[str, Any]) -> None:
    """Raise InputError or UnknownName unless all tables, keys and values are valid."""
    heads, tables = KEYS[""], [table for table in KEYS if table]
    for key in given:
        choice("key of the configuration", key, [*heads, *tables])
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
    choice("unit of time", given["recordings"].get("time_unit", "s"), TIME)


def _values(table: str, given: Mapping[str, Any], where: str) -> None:
    for key, value in given.items():
        choice(f"key of {where or 'the configuration'}", key, KEYS[table])
        fits, expected = KINDS[KEYS[table][key]]
        if not fits(value):
            if key in ("held_out", "fit") and value == []:  # `check` names a missing fit
                continue
            at = f"{where} {key}".strip()
            raise InputError(f"identify: {at} is {shorten(value)}, expected {expected}")
        if KEYS[table][key] == "unit":
            choice(f"unit of {where}", value, UNITS)


def shorten(value: Any) -> str:
    """Shorten a value for a message."""
    if isinstance(value, int) and abs(value) > 10**SHOWN:
        return f"an integer of {int(math.log10(abs(value))) + 1} digits"
    text = repr(value)
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def check_joints(model: Model, run: Recording, columns: Mapping[str, Column]) -> None:
    """Raise UnknownName or InputError unless the columns of joint sensors have valid joint names.

    For `ctrl` the names are actuators. One array with all columns in the order of the model needs
    no names.
    """
    for sensor in JOINT_SENSORS:
        if sensor not in run.channels:
            continue
        channel, size = run[sensor], getattr(model, JOINT_SENSORS[sensor])
        kind = "actuator" if sensor == HELD else "joint"
        known = model.actuator_names if sensor == HELD else model.joint_names
        named = [n for n, c in columns.items() if c.sensor == sensor]
        whole = len(named) == 1 and columns[named[0]].joint is None
        if whole and len(channel.names) == size:
            continue  # all of them, in the order of the model
        for name in channel.names:
            if name not in known:
                fix = UnknownName(f"{kind} of a column of sensor {sensor}", name, known)
                if whole or any(columns[n].joint is None for n in named):
                    raise InputError(
                        f"identify: {fix}; give joint = ... in the column's line, or an array with "
                        f"all {size} in the order of the model"
                    )
                raise fix
        _check_units(model, sensor, named, columns)


def _check_units(
    model: Model, sensor: str, named: Sequence[str], columns: Mapping[str, Column]
) -> None:
    """Raise UnknownName for a length unit of a hinge, or an angle unit of a slide."""
    turning, sliding = MOVES.get(sensor, ((), ()))
    for column in (columns[n] for n in named):
        joint = column.joint
        if not isinstance(joint, str) or joint not in model.joint_names:
            continue
        kind = model.topology.joint_kinds[model.joint_names.index(joint)]
        suited = {"hinge": turning, "slide": sliding}.get(kind, ())
        if column.unit and suited:
            choice(f"unit of the {kind} {joint} in sensor {sensor}", column.unit, suited)


def index_of(setup: Setup, leaf: str, index: Any) -> Any:
    """Convert an index of a job file to a numpy index.

    An integer or a name is one entry of the first axis. The name of a joint with several
    coordinates is all its entries. A list of integers or names is several entries. A list that
    begins with a name or a list, followed by integers, is an index on each axis: ["fore", 2],
    [["upper", "fore"], 2].
    """
    value = np.asarray(leaf_of(setup, leaf))
    if isinstance(index, list):
        first, rest = index[0], index[1:]
        places = isinstance(first, (list, str)) and bool(rest)
        places = places and all(not isinstance(x, str) for x in rest)
        if places:
            if len(index) > value.ndim:
                raise InputError(
                    f"identify: index of {leaf} is {shorten(index)}, a place on {len(index)} axes, "
                    f"expected one on {value.ndim}: {leaf} has shape {value.shape}"
                )
            found = _rows(setup, leaf, value, first), *(_plain(leaf, x) for x in rest)
            return _checked(leaf, value, found)
        rows = [_rows(setup, leaf, value, x) for x in index]
        return _checked(leaf, value, np.concatenate([np.atleast_1d(x) for x in rows]))
    return _checked(leaf, value, _rows(setup, leaf, value, index))


def _rows(setup: Setup, leaf: str, value: np.ndarray, index: Any) -> Any:
    """Convert an index on the first axis of a leaf. Names of entries become integers."""
    if isinstance(index, list):
        return np.concatenate([np.atleast_1d(_rows(setup, leaf, value, x)) for x in index])
    if not isinstance(index, str):
        return index
    names = _names(setup, leaf, value)
    if not names:
        raise InputError(
            f"identify: index of {leaf} is {index!r}, but its entries have no names; expected "
            f"integers from 0 to {len(value) - 1 if value.ndim else 0}"
        )
    places = [k for k, name in enumerate(names) if name == index]
    if not places:
        raise UnknownName(f"index of {leaf}", index, list(dict.fromkeys(names)))
    return places[0] if len(places) == 1 else np.array(places)


def _plain(leaf: str, index: Any) -> Any:
    if isinstance(index, list) and not all(isinstance(x, int) for x in index):
        raise InputError(
            f"identify: index of {leaf} has {shorten(index)} on a later axis, expected integers; "
            "only the first axis has names"
        )
    return np.array(index) if isinstance(index, list) else index


def _checked(leaf: str, value: np.ndarray, found: Any) -> Any:
    try:
        chosen = np.arange(value.size).reshape(value.shape)[found]
    except IndexError as error:
        raise InputError(
            f"identify: index of {leaf}: {error}; {leaf} has shape {value.shape}"
        ) from error
    if not chosen.size or len(np.unique(chosen)) < chosen.size:
        raise InputError(
            f"identify: index of {leaf} has {'no entry' if not chosen.size else 'an entry twice'}, "
            "expected different entries"
        )
    return found


def _names(setup: Setup, leaf: str, value: np.ndarray) -> Sequence[str]:
    """Return the names of the entries on the first axis of a leaf, or () without names."""
    model = setup.model
    parts = leaf.removeprefix("model.").split(".")
    kind, size = parts[0], len(value) if value.ndim else 0
    found: Sequence[str] = ()
    if kind == "bodies":
        found = model.body_names
    elif kind in ("actuators", "controller"):
        found = model.actuator_names
    elif kind == "sites":
        found = model.site_names
    elif kind == "forces" and len(parts) > 2:
        element = model.forces[int(parts[1])]
        found = _coordinates(model, getattr(element, "joints", None) or (), size)
    elif kind in ("joints", "readings") or (kind == "sensors" and parts[1] in JOINT_SENSORS):
        found = _coordinates(model, model.joint_names, size)
    elif kind == "sensors" and size == 3:
        found = "x", "y", "z"
    return found if len(found) == size else ()


def _coordinates(model: Model, joints: Sequence[Any], size: int) -> list[str]:
    """Repeat the names of joints to match `size` entries.

    There is one entry for each joint, velocity coordinate or configuration coordinate.
    """
    if not all(isinstance(j, (str, int)) for j in joints):
        return []
    names = [j if isinstance(j, str) else model.joint_names[j] for j in joints]
    for count in (
        lambda n: 1,
        lambda n: model.v_slice(n).stop - model.v_slice(n).start,
        lambda n: model.q_slice(n).stop - model.q_slice(n).start,
    ):
        found = [n for n in names for _ in range(count(n))]
        if len(found) == size:
            return found
    return []
