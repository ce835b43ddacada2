"""Fits that are saved and go on."""

import json

import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import identify
from tests.sysid.test_identify import DAMPING, GUESS, MASS, seen


def test_a_fit_that_was_cut_off_goes_on(tmp_path):
    path, unknowns = tmp_path / "fit.json", {"mass": MASS, "damping": DAMPING}
    run = seen(0, count=40)
    cut = identify(GUESS, run, unknowns, steps=1, restarts=0, save=path)
    assert not cut.ok
    left = json.loads(path.read_text())
    assert left["values"] == cut.values and not left["ok"]
    whole = identify(GUESS, run, unknowns, resume=path, save=path)
    assert whole.ok and json.loads(path.read_text())["ok"]
    np.testing.assert_allclose([*whole.values.values()], [1.4, 0.13], rtol=1e-8)
    assert whole.guess == cut.guess
    with pytest.raises(rb.InputError, match="only one of the two has: damping"):
        identify(GUESS, run, {"mass": MASS}, resume=path)
    with pytest.raises(rb.InputError, match="expected a file that a fit wrote"):
        identify(GUESS, run, unknowns, resume=tmp_path / "none.json")
