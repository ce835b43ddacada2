"""Fits that are saved and go on."""

import json

import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Grid, identify
from rbjax.sysid.estimators.identified import write_fit
from tests.sysid.test_identify import DAMPING, GUESS, MASS, seen


def test_a_fit_that_was_cut_off_goes_on(tmp_path):
    path, unknowns = tmp_path / "fit.json", {"mass": MASS, "damping": DAMPING}
    run = seen(0, count=40)
    far = GUESS.replace(bodies=GUESS.bodies.replace(mass=np.array([40.0])))
    cut = identify(far, run, unknowns, max_evaluations=1, restarts=0, save=path)
    assert not cut.success
    left = json.loads(path.read_text())
    assert left["values"] == cut.values and not left["success"]
    whole = identify(far, run, unknowns, resume=path, save=path)
    assert whole.success and json.loads(path.read_text())["success"]
    np.testing.assert_allclose([*whole.values.values()], [1.4, 0.13], rtol=1e-8)
    assert whole.guess == cut.guess
    with pytest.raises(rb.InputError, match="only one of the two has: damping"):
        identify(GUESS, run, {"mass": MASS}, resume=path)
    with pytest.raises(rb.InputError, match="expected a file that a fit wrote"):
        identify(GUESS, run, unknowns, resume=tmp_path / "none.json")


def test_corrections_of_other_recordings_are_rejected(tmp_path):
    """They were cut off, or filled up with 0, in silence."""
    path, run = tmp_path / "fit.json", seen(0, count=40)
    write_fit(path, ["mass"], np.array([1.2, 0.1, 0.0]))  # q and v of one recording
    with pytest.raises(rb.InputError, match=r"holds 2 corrections .* expected 4 for 2 recordings"):
        identify(
            GUESS, [run, seen(1, count=40)], {"mass": MASS}, estimate_initial_state=True,
            resume=path,
            grid=Grid(0.01),
        )  # fmt: skip
    write_fit(path, ["mass"], np.array([1.2, 0.1, 0.0, 0.0, 0.0]))
    with pytest.raises(rb.InputError, match=r"holds 4 corrections .* expected 2 for 1 recordings"):
        identify(
            GUESS, [run], {"mass": MASS}, estimate_initial_state=True, resume=path, grid=Grid(0.01)
        )
