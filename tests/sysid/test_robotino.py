"""Slip by floor: of a real robot, on headings that were not fitted; of one whose slip is known."""

import numpy as np
import pytest

from benchmarks.cases.robotino import (
    ARM,
    DATA,
    FLOORS,
    Run,
    fit,
    load,
    path_errors,
    repeatability,
    robotino,
)
from rbjax import wheeled

# mean size of the error of one run, held out; on green equal runs differ by more than 2 %
EACH = {"table": 0.005, "brown": 0.01, "gray": 0.015, "green": 0.035}
ENCODERS = {"table": 0.09, "brown": 0.13, "gray": 0.28, "green": 0.49}


@pytest.mark.slow
@pytest.mark.parametrize("floor", FLOORS)
def test_on_headings_not_fitted_paths_are_as_long_as_the_camera_says(floor):
    if not DATA.exists():
        pytest.skip(f"the recordings of the robot are not there: {DATA.name}")
    robot, runs = robotino(), load(floor)
    found = fit(robot, [run for run in runs if not run.held_out])
    unseen = [run for run in runs if run.held_out]
    assert len(unseen) == len(runs) / 2
    error = path_errors(robot, unseen, found.slip)
    assert abs(error.mean()) < 0.02
    assert np.abs(error).mean() < EACH[floor]
    assert path_errors(robot, unseen, None).mean() > ENCODERS[floor]
    assert found.comparisons[0].significant  # slip that depends on the heading, beside one radius


@pytest.mark.slow
def test_green_carpet_does_not_repeat_itself_within_two_percent():
    if not DATA.exists():
        pytest.skip(f"the recordings of the robot are not there: {DATA.name}")
    assert repeatability(load("green")) > 0.02


@pytest.mark.parametrize("harmonics", [1, 3])
def test_a_known_slip_is_found_with_its_harmonics_and_no_more(harmonics):
    robot, rng = robotino(), np.random.default_rng(0)
    slip = wheeled.HeadingSlip.none(ARM, harmonics)
    C = 0.8 * np.asarray(slip.coefficients) + 0.04 * rng.normal(size=slip.coefficients.shape)
    slip = slip.replace(coefficients=C)
    t, runs = np.linspace(0.0, 10.0, 5), []
    for heading in range(0, 360, 10):
        psi = np.deg2rad(heading)
        turn = 0.2 * np.sin(3 * psi) + rng.normal(scale=0.05)
        speeds = wheeled.commands(robot, [0.1 * np.cos(psi), 0.1 * np.sin(psi), turn]).speeds
        angles = t[:, None] * np.asarray(speeds)
        poses = np.array(wheeled.odometry(robot, t, angles, slip))
        poses[1:] += 1e-4 * rng.normal(size=(4, 3))
        runs.append(Run(heading, 0.1, t, angles, poses))
    found = fit(robot, runs)
    assert found.name == f"up to harmonic {harmonics}"
    # 0.1 mm on 0.8 m, seen by 36 runs
    np.testing.assert_allclose(found.slip.coefficients, C, atol=1e-3)
