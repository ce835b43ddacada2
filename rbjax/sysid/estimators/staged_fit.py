"""The successive fits of `identify`. Each one starts from the result of the last one.

fit_segments            short segments, each from its first sample, for a poor first guess
fit_multiple_shooting   segments with growing continuity weights, for a long motion
fit_growing             the first part of all recordings, then longer parts, for a poor guess
fit_all                 all recordings
reweigh                 all recordings, each column weighted by the noise of its residuals
refine_steps            all recordings with shorter steps, if half the length changes the fit
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.progress import Say
from rbjax.rank_tolerances import rank_tolerance
from rbjax.sensors.columns import root_mean_square
from rbjax.sysid.data.recording import Recording, noise_is_stated
from rbjax.sysid.estimators.identified import FitOptions, write_fit
from rbjax.sysid.estimators.least_squares import (
    PRIOR_WEIGHTS,
    Minimum,
    minimise,
    minimise_by_differences,
)
from rbjax.sysid.estimators.verdict import NORMAL, is_poor, roughness
from rbjax.sysid.parameters.unknown_vector import Unknowns, draw_guesses
from rbjax.sysid.parameters.unknowns import Unknown
from rbjax.sysid.simulation.multiple_shooting import CONTINUITY_WEIGHTS, MultipleShooting
from rbjax.sysid.simulation.runs import Run, default_grid, make_batch, make_run
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError, sum_of_squares
from rbjax.sysid.simulation.traces import Traces, make_traces, residuals_of

#: an RMS below this fraction of a channel's standard deviation is rounding
NOISELESS = 1e-7
#: prior weights of a fit that is only the start of another fit
FIRST_WEIGHTS = (1e-4, 1e-7)
#: successive parts of all recordings in a growing fit
PARTS = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
#: the largest number of evaluations of a fit to a part
FEW_STEPS = 20
#: the spread of other first guesses, as in `many_starts`
SPREAD = 1.0
#: largest factor of step refinement before the fit; largest number of refinements after it
FINEST, REFINED = 16, 2
#: largest change of an unknown by the error of the steps, relative to its standard deviation
STEP_ERROR = 0.5
#: largest error of the steps, relative to the spread of the recordings, that is always accepted
SMALL_STEP_ERROR = 1e-6


class Fit(NamedTuple):
    """A fit of all recordings. `noise_estimated` is True if the weights are estimates."""

    error: SimulationError
    minimum: Minimum
    traces: Traces
    noise_estimated: bool = False


class StagedFit:
    """Fits of the same unknowns to the same recordings.

    Fields:
        first: first guess.
        prior: values in the unidentifiable directions.
        grid: grid of the simulation, which may be refined.
        checks_steps: whether the length of the steps is checked.
        evaluations: number of evaluations of residuals up to now.
        notes: sentences on default choices.
    """

    def __init__(
        self, setup: Setup, unknowns: Unknowns, recordings: Sequence[Recording], 
        options: FitOptions, *, save: str | Path | None = None, say: Say = lambda text: None,
    ):  # fmt: skip
        self.setup, self.unknowns, self.recordings = setup, unknowns, recordings
        self.options, self.save, self.say = options, save, say
        self.grid, self.checks_steps = start_grid(setup, unknowns, recordings, options.grid)
        self.first = np.asarray(unknowns.read(setup), float)
        self.prior = self.first
        self.evaluations = 0
        self.notes: list[str] = []

    def fit_segments(self, x: np.ndarray, seconds: float) -> np.ndarray:
        """Fit the unknowns to segments of this length in s."""
        short = [segment for run in self.recordings for segment in run.segments(seconds)]
        found = self._minimise(self.error(short), x, last=False, prior_weights=FIRST_WEIGHTS)
        return found.x[: self.shared]

    def fit_multiple_shooting(self, x: np.ndarray, seconds: float) -> np.ndarray:
        """Fit the unknowns by multiple shooting, and the initial states if they are estimated."""
        single = [make_run(self.setup, run, self.grid) for run in self.recordings]
        of = MultipleShooting(
            self.setup, self.unknowns, single, self.grid, seconds, loss=self.options.loss
        )
        for of.continuity_weight in CONTINUITY_WEIGHTS:
            # the prior's weight is relative to the largest curvature, which comes from the gaps
            weights = tuple(w / max(of.continuity_weight, 1.0) ** 2 for w in FIRST_WEIGHTS)
            x = self._minimise(of, x, last=False, prior_weights=weights).x
        if not self.error(self.recordings).own:
            return x[: self.shared]
        # the error of a chaotic motion is steep: a prior at the first guess would lose the minimum
        self.prior = of.merge(x)
        return self.prior

    def fit_all(self, x: np.ndarray) -> Fit:
        """Fit all recordings."""
        of = self.error(self.recordings)
        if of.own and x.size not in (self.shared, of.size):
            raise InputError(
                f"identify: resume holds {x.size - self.shared} corrections of initial states, "
                f"expected {of.size - self.shared} for {of.count} recordings; resume with the "
                "recordings that were fitted, or with the values alone (a dict name -> value)"
            )
        return self._fit(of, x)

    def fit_growing(self, of: SimulationError, x: np.ndarray) -> np.ndarray:
        """Fit the first part of all recordings, then longer parts.

        Over a short time the motion of a poor guess remains near the recording. All parts use the
        program of the complete recordings.
        """
        T = max(float(np.max(t)) for t in of.runs.times.values())
        for part in PARTS:
            weights = {
                s: w * (of.runs.times[s] <= part * T)[..., None] for s, w in of.runs.weights.items()
            }
            some = of.on(of.runs._replace(weights=weights))
            if some.samples <= 2 * some.size:
                continue
            x = self._minimise(
                some, x, last=False, prior_weights=FIRST_WEIGHTS, max_evaluations=FEW_STEPS
            ).x
        return x

    def retry_if_poor(self, fit: Fit) -> Fit:
        """Retry a poor fit with growing fits from several guesses, and return the best fit."""
        restarts = self.options.restarts
        why = "the first guess failed" if not np.isfinite(fit.minimum.cost) else ""
        why = why or self._why_poor(fit)
        if not (why and restarts):
            return fit
        of, best, tried, won = fit.error, fit, 0, "the first guess is still the best"
        for k, guess in enumerate(self._guesses(restarts)):
            x = self.fit_growing(of, np.append(guess, np.zeros(of.size - self.shared)))
            # a prior at the first guess would lose the result of the parts
            other = self._fit(of, x, prior=x)
            tried = k + 1
            if other.minimum.cost < best.minimum.cost * (1 - 1e-6):
                best = other
                won = "a fit that grew from the first part of the recordings " + (
                    f"and from another guess (number {k}) is better" if k else "is better"
                )
            if not self._why_poor(best):
                break
        self.notes.append(
            f"the fit from the first guess was poor ({why}), so {tried} other "
            f"{'start was' if tried == 1 else 'starts were'} tried: {won}"
        )
        return best

    def _why_poor(self, fit: Fit) -> str:
        robust = self.options.loss == "huber"
        return is_poor(fit.traces, self.recordings, self.setup, robust=robust)

    def _guesses(self, count: int) -> np.ndarray:
        """Return the first guess and other guesses (count, n)."""
        try:
            return draw_guesses(self.unknowns, self.setup, count, SPREAD, 0)
        except InputError:  # for a kind of unknown without random guesses
            return self.first[None]

    def reweigh(self, fit: Fit) -> Fit:
        """Repeat a fit with weights from the noise of its residuals.

        The fit is returned unchanged if all channels state their noise or the residuals are
        rounding.
        """
        robust = self.options.loss == "huber"
        data = estimate_weights(fit.error.runs, fit.traces, self.recordings, robust=robust)
        if data is None:
            return fit
        return self._refit(fit.error.on(data), fit.minimum.x)._replace(noise_estimated=True)

    def shorten_steps(self) -> None:
        """Shorten the steps until their error at the first guess is below the noise."""
        if not self.checks_steps:
            return
        of = self.error(self.recordings)
        x = np.append(self.first, np.zeros(of.size - self.shared))
        first, largest, done = self.grid, 0.0, 1
        while done < FINEST:
            other = self.error(self.recordings, halve_steps(self.grid))
            error = error_over_noise(of, other.residuals(x) - of.residuals(x), self.recordings)
            largest = max(largest, error)
            if not error > 1:
                break
            # an error of order 4 decreases by a factor of 16 if the step is halved
            times = 2 if error > 16 and 4 * done <= FINEST else 1
            self.grid = halve_steps(self.grid, times)
            done *= 2**times
            of = other if times == 1 else self.error(self.recordings)
        self._note_steps(first, largest)

    def _note_steps(self, first: Grid, error: float) -> None:
        if self.grid == first:
            return
        why = (
            f"their error is {error:.2g} times what matters" if error > 1 else "the search stalled"
        )
        self.notes.append(
            f"steps of {first.period / first.substeps:.3g} s were too long ({why}), so the motion "
            f"has steps of {self.grid.period / self.grid.substeps:.3g} s; grid= sets them"
        )

    def refine_steps(self, fit: Fit) -> Fit:
        """Repeat a fit with halved steps of the simulation until a further halving has no effect.

        It has no effect if the changes of the unknowns are small compared with their standard
        deviations. The steps are also halved if the search stalls: with long steps, in which
        friction changes its sign, the error is not smooth.
        """
        if not self.checks_steps:
            return fit
        first, worst, best, needed = self.grid, 0.0, fit, False
        for _ in range(REFINED):
            other = self.error(self.recordings, halve_steps(best.error.grid))
            other = other.on(other.runs._replace(weights=best.error.runs.weights))
            error, matters = step_error(best, other)
            if not matters and best.minimum.success:
                break
            found = self._refit(other, best.minimum.x)
            if found.minimum.cost > 2 * best.minimum.cost:  # data simulated with long steps
                break
            worst, needed = max(worst, error), needed or matters or found.minimum.success
            best = found._replace(noise_estimated=fit.noise_estimated)
        if not needed:
            return fit
        self.grid = best.error.grid
        self._note_steps(first, worst)
        return best

    @property
    def shared(self) -> int:
        """The number of unknowns, without corrections of initial states."""
        return len(self.first)

    def error(self, recordings: Sequence[Recording], grid: Grid | None = None) -> SimulationError:
        """Create the simulation error of recordings."""
        grid = self.grid if grid is None else grid
        return SimulationError(
            self.setup, self.unknowns, make_batch(self.setup, recordings, grid), grid,
            estimate_initial_state=self.options.estimate_initial_state, loss=self.options.loss,
            difference_step=self.options.difference_step,
        )  # fmt: skip

    def _fit(self, of: SimulationError, x: np.ndarray, **how: Any) -> Fit:
        found = self._minimise(of, x, **how)
        return Fit(of, found, make_traces(self.setup, of, found.x, self.recordings))

    def _refit(self, of: SimulationError, x: np.ndarray) -> Fit:
        """Fit again from x, the minimum of a slightly different error. x is also the prior."""
        return self._fit(of, x, prior=x, prior_weights=PRIOR_WEIGHTS[-1:])

    def _minimise(
        self, of: SimulationError | MultipleShooting, x: np.ndarray, *, last: bool = True,
        prior: np.ndarray | None = None, max_evaluations: int | None = None, **how: Any,
    ) -> Minimum:  # fmt: skip
        self.say("simulating")
        prior = self.prior if prior is None else prior
        x, near = (np.append(a, np.zeros(of.size))[: of.size] for a in (x, prior))
        slopes = of.triangle(x)
        if last:
            check_sensitivity(self.unknowns, slopes[:, : self.shared])
        least = np.inf
        most = self.options.max_evaluations if max_evaluations is None else max_evaluations

        def watch(k: int, cost: float, x: np.ndarray) -> None:
            nonlocal least
            self.say(f"evaluation {k} of at most {most}, squares {cost:.4g}")
            if self.save is not None and cost < least:
                least = cost
                kept = x if last else x[: self.shared]  # without the initial states of segments
                write_fit(self.save, self.unknowns.names, kept, success=False, status="running")

        how |= {"triangle": slopes, "max_evaluations": most, "watch": watch}
        if self.options.difference_step is None:
            found = minimise(of, x, near, **how)
        else:
            found = minimise_by_differences(of, x, near, step=self.options.difference_step, **how)
        self.evaluations += found.evaluations
        return found


def estimate_weights(
    data: Run, seen: Traces, runs: Sequence[Recording], *, robust: bool
) -> Run | None:
    """Estimate weights 1 / sigma from the residuals, for channels without stated noise.

    Return None if all channels state their noise, or if the residuals are rounding. With `robust`,
    sigma is a robust estimate, which ignores outliers.
    """
    weights, changed = dict(data.weights), False
    for sensor in data.values:
        if noise_is_stated(runs, sensor):
            continue
        r, spread = residuals_of(seen, sensor), np.asarray(data.values[sensor]).std(axis=(0, 1))
        if (~np.isnan(r)).sum(0).max() <= len(runs):  # only initial states were measured
            continue
        missing = np.isnan(r).all(0)
        r = np.where(missing, 1.0, r)
        sigma = NORMAL * np.nanmedian(np.abs(r), 0) if robust else root_mean_square(r)
        sigma = next(iter(seen.values()))[sensor].columns.noise(sigma)
        if not (sigma > NOISELESS * spread).all():
            return None
        weights[sensor] = jnp.asarray((np.asarray(weights[sensor]) > 0) / sigma)
        changed = True
    return data._replace(weights=weights) if changed else None


def check_sensitivity(unknowns: Unknowns, J: np.ndarray) -> None:
    """Raise InputError if an unknown has no effect on any reading."""
    ends = np.cumsum(unknowns.sizes)
    largest, still = np.abs(J).max(), rank_tolerance("unknown without effect", J.dtype)
    for (name, u), end, size in zip(unknowns.members.items(), ends, unknowns.sizes, strict=True):
        if np.isfinite(largest) and not np.abs(J[:, end - size : end]).max() > still * largest:
            raise InputError(
                f"identify: {name} ({u!r}) moves nothing that was recorded, expected unknowns that "
                "do: leave it out, or record a motion or a sensor that shows it"
            )


def start_grid(
    setup: Setup, unknowns: Unknowns, runs: Sequence[Recording], grid: Grid | None
) -> tuple[Grid, bool]:
    """Choose the first grid, and whether to check its steps (grid is None or has 0 substeps)."""
    if grid is None:
        ends = [
            u.bounds[1] for u in unknowns.members.values()
            if isinstance(u, Unknown) and u.leaf == "delay" and u.bounds and u.bounds[1] < np.inf
        ]  # fmt: skip
        return default_grid(runs, setup, longest=max(ends, default=None)), True
    if isinstance(grid, Grid) and isinstance(grid.substeps, int) and grid.substeps == 0:
        return grid._replace(substeps=1), True
    return grid, False


def halve_steps(grid: Grid, times: int = 1) -> Grid:
    """Halve the steps of a grid `times` times."""
    k = 2**times
    return grid._replace(period=grid.period / k, longest_delay=k * grid.longest_delay)


def error_over_noise(of: SimulationError, e: np.ndarray, recordings: Sequence[Recording]) -> float:
    """Compute the ratio of an error e (runs, rows) of the residual to the largest acceptable one.

    The acceptable error follows from the noise of the recordings. Rounding errors count as 0.
    """
    squares = 0.0
    for sensor, part in of.rows_of(e).items():
        y, w = np.asarray(of.runs.values[sensor]), np.asarray(of.runs.weights[sensor])
        spread = float(np.sqrt(np.mean((y - y.mean((0, 1))) ** 2)))
        noise, least = 1.0, SMALL_STEP_ERROR * spread
        if noise_is_stated(recordings, sensor):  # the rows are in units of the noise
            least *= float(w.max(initial=0.0))
        else:
            rough = np.max([roughness(run[sensor].values) for run in recordings], 0)
            rough = rough[np.isfinite(rough)]
            if not rough.any():  # too few samples, or constant ones
                continue
            noise = float(np.sqrt(np.mean(rough**2)))
        found = sum_of_squares(part)
        squares += found / noise**2 if found > least**2 * part.size else 0.0
    return float(np.sqrt(squares)) / STEP_ERROR


def step_error(fit: Fit, other: SimulationError) -> tuple[float, bool]:
    """Compute the ratio of the error of the steps to the largest acceptable one.

    Also return whether the steps must be shorter. An error e of the residuals changes a fitted
    unknown by at most |e| / s of its standard deviation. s^2 is the variance of the residuals.
    """
    of, x = fit.error, fit.minimum.x
    e = other.residuals(x) - of.residuals(x)
    s = np.sqrt(max(fit.minimum.cost, 1e-300) / max(of.samples - of.size, 1))
    over = float(np.sqrt(sum_of_squares(e)) / (STEP_ERROR * s))
    size = 0.0
    for sensor, w in of.runs.weights.items():
        y = np.asarray(of.runs.values[sensor])
        size += sum_of_squares(np.asarray(w) * (y - y.mean((0, 1))))
    small = sum_of_squares(e) <= SMALL_STEP_ERROR**2 * size
    return over, bool(over > 1 and not small)
