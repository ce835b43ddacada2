"""The tolerances of rank decisions are in one table."""

import re
from pathlib import Path

import numpy as np
import pytest

from rbjax.rank_tolerances import TABLE, rank_tolerance

SOURCES = [p.read_text() for p in (Path(__file__).parents[1] / "rbjax").rglob("*.py")]


@pytest.mark.parametrize("name", TABLE)
def test_a_tolerance_is_above_rounding_and_used(name: str) -> None:
    assert np.finfo(np.float32).eps < rank_tolerance(name, np.float32) <= 1.0
    assert np.finfo(float).eps < rank_tolerance(name, np.float64) < 1e-5
    assert rank_tolerance(name, np.float64) < rank_tolerance(name, np.float32)
    assert any(re.search(rf'"{name}"(?!: RankTolerance)', text) for text in SOURCES), name


def test_an_unknown_decision() -> None:
    with pytest.raises(KeyError):
        rank_tolerance("typo", np.float64)
