"""Whether steps of integration are short enough for the noise of the recordings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from rbjax.sysid.data.recording import Recording, says_its_noise
from rbjax.sysid.estimators.fit_rows import samples_of
from rbjax.sysid.estimators.verdict import roughness
from rbjax.sysid.parameters.unknowns import Unknown, Unknowns
from rbjax.sysid.simulation.runs import grid_of
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError, sum_of_squares

if TYPE_CHECKING:
    from rbjax.sysid.estimators.fits import Fitted

#: steps are short enough if their error moves no number by more than this part of its sigma
STEP_ERROR = 0.5
#: an error of steps below this part of the spread of what was recorded is no reason for finer ones
SMALL_STEP_ERROR = 1e-6


def start_grid(
    setup: Setup, sought: Unknowns, runs: Sequence[Recording], grid: Grid | None
) -> tuple[Grid, bool]:
    """The grid to begin with, and whether its steps are to be checked: if it is None, or has 0
    substeps."""
    if grid is None:
        ends = [
            u.bounds[1] for u in sought.members.values()
            if isinstance(u, Unknown) and u.leaf == "delay" and u.bounds and u.bounds[1] < np.inf
        ]  # fmt: skip
        return grid_of(runs, setup, longest=max(ends, default=None)), True
    if isinstance(grid, Grid) and isinstance(grid.substeps, int) and grid.substeps == 0:
        return grid._replace(substeps=1), True
    return grid, False


def halved(grid: Grid, times: int = 1) -> Grid:
    """The grid with steps of half the length, so many times over."""
    k = 2**times
    return grid._replace(period=grid.period / k, longest_delay=k * grid.longest_delay)


def over_noise(of: SimulationError, e: np.ndarray, recordings: Sequence[Recording]) -> float:
    """By how much an error (runs, rows) of the residual is larger than what matters, with the
    noise that the recordings show; 0 below rounding."""
    squares, at = 0.0, 0
    for sensor in sorted(of.runs.values):
        T, n = of.runs.values[sensor].shape[1:]
        columns = of.setup.columns(sensor)
        d = n - len(columns.turns)
        part = e[:, at : at + T * d].reshape(len(e), T, d)
        at += T * d
        y, w = np.asarray(of.runs.values[sensor]), np.asarray(of.runs.weights[sensor])
        spread = float(np.sqrt(np.mean((y - y.mean((0, 1))) ** 2)))
        if says_its_noise(recordings, sensor):  # rows are in units of it
            noise, least = 1.0, SMALL_STEP_ERROR * spread * float(w.max(initial=0.0))
        else:
            rough = np.max([roughness(run[sensor].values) for run in recordings], 0)
            rough = rough[np.isfinite(rough)]
            if not rough.any():  # too few samples, or constant ones: they show no noise
                continue
            noise = float(np.sqrt(np.mean(rough**2)))
            least = SMALL_STEP_ERROR * spread
        found = sum_of_squares(part)
        squares += found / noise**2 if found > least**2 * part.size else 0.0
    return float(np.sqrt(squares)) / STEP_ERROR


def step_error(fitted: Fitted, other: SimulationError) -> tuple[float, bool]:
    """By how much the error of the steps is larger than what matters, and whether it does. The
    residuals r have n numbers fitted to them; an error e of theirs moves a number by |e| / s of its
    standard deviation at most, where s^2 is the variance of r."""
    of, x = fitted.error, fitted.least.x
    e = other.residuals(x) - of.residuals(x)
    s = np.sqrt(max(fitted.least.cost, 1e-300) / max(samples_of(of) - of.size, 1))
    over = float(np.sqrt(sum_of_squares(e)) / (STEP_ERROR * s))
    size = 0.0
    for sensor, w in of.runs.weights.items():
        y = np.asarray(of.runs.values[sensor])
        size += sum_of_squares(np.asarray(w) * (y - y.mean((0, 1))))
    small = sum_of_squares(e) <= SMALL_STEP_ERROR**2 * size
    return over, bool(over > 1 and not small)
