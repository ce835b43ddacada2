"""Every public function of arrays on the grid of dtypes, batches and transformations."""

import importlib
import inspect
import pkgutil
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import rbjax as rb
from tests.public.elsewhere import ELSEWHERE
from tests.public.grid import check_grid, check_types
from tests.public.tables import TABLES

NAMES = [(room, name) for room, cases in TABLES.items() for name in cases]
# the others are tested in f64 by files named test_composes and test_registry
IN_F32 = [(room, name) for room, name in NAMES if np.float32 in TABLES[room][name].dtypes]
every = pytest.mark.parametrize(("room", "name"), NAMES, ids=[f"{r}-{n}" for r, n in NAMES])


@pytest.mark.parametrize(("room", "name"), IN_F32, ids=[f"{r}-{n}" for r, n in IN_F32])
def test_types(room: str, name: str) -> None:
    check_types(TABLES[room][name])


@pytest.mark.slow
@every
def test_on_the_grid(room: str, name: str) -> None:
    check_grid(TABLES[room][name])


ROOMS = {m.name for m in pkgutil.iter_modules(rb.__path__) if m.ispkg} - {"motion"} | {"rb"}
ALL_TESTS = Path(__file__).parent.parent
#: rooms whose functions are cases of a table of another name
TABLE_OF = {"rb": "models", "dynamics": "models", "forces": "models", "spatial": "bodies",
            "sensors": "models", "body": "bodies", "kinematics": "control"}  # fmt: skip
SUBROOMS = {f"control.{name}" for name in ("laws", "linear", "optimal")}
TABLE_OF |= dict.fromkeys(SUBROOMS, "control")


def package(room: str) -> Any:
    return rb if room == "rb" else importlib.import_module(f"rbjax.{room}")


def with_a_case(room: str) -> set[str]:
    """Names of a room in its table: a case is "name", "room.name" or "name, variant"."""
    table = TABLES.get(TABLE_OF.get(room, room), {})
    names = (case.partition(",")[0].rpartition(".") for case in table)
    rooms = {room, ""}
    return {name for owner, _, name in names if owner in rooms}


def test_every_room_is_listed() -> None:
    assert ELSEWHERE.keys() == ROOMS | SUBROOMS
    assert not hasattr(importlib.import_module("rbjax.motion"), "__all__")


@pytest.mark.parametrize("room", ELSEWHERE)
def test_no_public_function_is_missing(room: str) -> None:
    values = {name: getattr(package(room), name) for name in package(room).__all__}
    rooms = {n: x for n, x in values.items() if hasattr(x, "__path__") and room != "rb"}
    for inner in [x for n, x in rooms.items() if f"{room}.{n}" not in ELSEWHERE]:
        values |= {name: getattr(inner, name) for name in getattr(inner, "__all__", ())}
    public = {n for n, x in values.items() if callable(x) and not inspect.isclass(x)}
    missing = public - with_a_case(room) - ELSEWHERE[room]
    assert not missing, f"give {sorted(missing)} of {room} a case in tests/public"
    unknown = ELSEWHERE[room] - public
    assert not unknown, f"{sorted(unknown)} are not public functions of {room}"
    twice = ELSEWHERE[room] & with_a_case(room)
    assert not twice, f"{sorted(twice)} of {room} have a case"


def test_functions_without_a_case_are_used_by_other_tests() -> None:
    paths = [p for p in ALL_TESTS.rglob("test_*.py") if p.parent.name not in ("public", "mutation")]
    words = {word for path in paths for word in re.findall(r"\w+", path.read_text())}
    for room, names in ELSEWHERE.items():
        if room == "model":  # parts of `Model` that every algorithm uses
            continue
        assert names <= words, f"no test has {sorted(names - words)} of {room}"
