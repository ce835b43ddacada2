"""Names in a job file: joints of columns, and entries in the indices of unknowns."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rbjax.errors import InputError, UnknownName
from rbjax.model import Model
from rbjax.sysid.data.readers import Column
from rbjax.sysid.data.recording import HELD, JOINT_SENSORS, Recording
from rbjax.sysid.data.units import MOVES
from rbjax.sysid.jobs.keys import shorten
from rbjax.sysid.parameters.unknowns import leaf_of
from rbjax.sysid.simulation.setup import Setup


def check_joints(model: Model, run: Recording, columns: Mapping[str, Column]) -> None:
    """Raise `UnknownName` or `InputError` unless each column of a joint's sensor names a joint (for
    `ctrl` an actuator), or one array has all columns in the order of the model."""
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
    """Raise `UnknownName` for an angle's unit of a slide, or a length's unit of a hinge."""
    turning, sliding = MOVES.get(sensor, ((), ()))
    for column in (columns[n] for n in named):
        joint = column.joint
        if not isinstance(joint, str) or joint not in model.joint_names:
            continue
        kind = model.topology.joint_kinds[model.joint_names.index(joint)]
        suited = {"hinge": turning, "slide": sliding}.get(kind, ())
        if column.unit and suited and column.unit not in suited:
            raise UnknownName(f"unit of the {kind} {joint} in sensor {sensor}", column.unit, suited)


def index_of(setup: Setup, leaf: str, index: Any) -> Any:
    """Convert an index of a job file to an index of numpy.

    An integer or a name is an entry of the first axis (of a joint with several coordinates, all
    its entries). A list of integers, or of names, is several entries. A list of a name or a list,
    followed by integers, is an index on each axis: ["fore", 2], [["upper", "fore"], 2].
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
    """The entries of the first axis."""
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
    """The names of the entries of the first axis of a leaf, a joint's for each of its
    coordinates."""
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
    """The names of joints, repeated for each of their entries: one a joint, one a velocity, or one
    a configuration coordinate."""
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
