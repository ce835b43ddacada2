"""Every public function of arrays on the grid of dtypes, batches and transformations."""

import inspect

import numpy as np
import pytest

import rbjax as rb
from tests.public.grid import check_grid, check_types
from tests.public.tables import ELSEWHERE, TABLES

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


@pytest.mark.parametrize("room", ELSEWHERE)
def test_no_public_function_is_missing(room: str) -> None:
    package = rb if room == "rb" else getattr(rb, room)
    values = {name: getattr(package, name) for name in package.__all__}
    public = {n for n, x in values.items() if callable(x) and not inspect.isclass(x)}
    cases = {name.split(",")[0].rpartition(".")[2] for table in TABLES.values() for name in table}
    missing = public - cases - ELSEWHERE[room]
    assert not missing, f"give {sorted(missing)} of {room} a case in tests/public/tables.py"
    unknown = ELSEWHERE[room] - public
    assert not unknown, f"{sorted(unknown)} are not public functions of {room}"
