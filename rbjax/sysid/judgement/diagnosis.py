"""`diagnose`: detection of mistakes in recordings, by comparison with simulated motions.

Each hypothesis has a correction: change a sign, swap two columns, stretch a clock, drop samples.
The most promising corrections are verified by a fit. A hypothesis is a cause if the fit to the
corrected data has at most half of the error of the fit without the correction. The error is

    e^2 = mean over columns of  mean (simulated - recorded)^2 / var(recorded)
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage, optimize

from rbjax.arguments import instance, integer
from rbjax.progress import Say, progress_line
from rbjax.sysid.data.recording import HELD, Recording
from rbjax.sysid.data.recording_checks import FAR, hampel
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.estimators.least_squares import minimise
from rbjax.sysid.estimators.staged_fit import FIRST_WEIGHTS
from rbjax.sysid.judgement.corrections import (
    Cause,
    Correction,
    Diagnosis,
    Lost,
    drop_samples,
    estimate_clock_rate,
    flip,
    stretch,
    swap,
)
from rbjax.sysid.simulation.runs import Run, make_run, order_columns, stack_runs
from rbjax.sysid.simulation.traces import FEW, Trace, Traces, make_traces
from rbjax.sysid.statistics.precision import in_double

BETTER = 0.5  # largest ratio of the errors with and without a correction
SUSPECT = 0.3  # columns with a larger relative error are tested for a wrong sign or place
SAME = 1.0001  # largest ratio of two errors that are the same
TRIED = 3  # number of corrections that are verified by a fit
NEAR, SLOW = 0.01, 2e-3  # search range of a refined clock rate; least reported rate
#: thresholds of a dead sensor: least share of the recording with a constant signal, largest scatter
#: relative to the simulated motion, and least simulated motion during that time
DEAD, QUIET, MUCH = 0.1, 0.02, 0.2
REPEATS = 3  # largest number of alternations of correction and fit


class Hypothesis(NamedTuple):
    """A possible mistake in the recordings, and its correction."""

    kind: str
    channels: tuple[str, ...]
    columns: tuple[str, ...]
    correction: Correction
    words: str


@in_double
def diagnose(found: Identified, *, max_evaluations: int = 15, progress: bool = False) -> Diagnosis:
    """Find mistakes in the recordings of a poor fit, such as a wrong sign, and correct them.

    Args:
        found: result of `identify`. Its first guess must explain most of the motion.
        max_evaluations: largest number of evaluations of each fit that verifies a correction.
        progress: show a progress line.

    Returns:
        `Diagnosis`, with the corrected recordings for a new fit.

    Raises:
        InputError: not the result of `identify`, or a number of evaluations below 1.

    Example:
        >>> import rbjax as rb, numpy as np
        >>> from rbjax.sysid import Channel, Recording, Unknown, diagnose, identify
        >>> model, t = rb.load("pendulum"), np.arange(101) * 0.01
        >>> push = 3.0 * np.ones((100, 1))
        >>> seen = rb.rollout(model, model.default_state(), push, 0.01, integrator="rk4")
        >>> q, wrong = Channel(t, seen.q), Channel(t, seen.v, sign=-1)
        >>> run = Recording("swing", {"q": q, "v": wrong, "ctrl": Channel(t[:-1], push)})
        >>> found = identify(model, run, {"mass": Unknown("bodies.mass", positive=True)})
        >>> [(cause.kind, cause.channels) for cause in diagnose(found).causes]
        [('sign', ('v',))]
    """
    instance("diagnose", "found", found, Identified, "Identified: the result of `identify`")
    integer("diagnose", "max_evaluations", max_evaluations, least=1)
    with progress_line("diagnose", progress) as say:
        return _Trials(found, max_evaluations, say).diagnosis()


class _Trials:
    """Trials of corrections with one compiled simulation."""

    def __init__(self, found: Identified, max_evaluations: int, say: Say):
        self.found, self.max_evaluations, self.say = found, max_evaluations, say
        self.model, self.setup = found.error.setup.model, found.error.setup
        self.guess = np.array([*found.guess.values()])
        self.make_run = functools.partial(make_run, self.setup, grid=found.grid)
        self.longest = [self.make_run(order_columns(self.model, run)) for run in found.recordings]

    def diagnosis(self) -> Diagnosis:
        """Correct the recordings until no hypothesis halves the error."""
        runs = [order_columns(self.model, run) for run in self.found.recordings]
        x = np.array([*self.found.values.values()])
        x = min((x, self.guess), key=lambda y: self.error(runs, y))
        runs, x, causes = self.correct(runs, x)
        runs, x, lost = self.drop_bad_samples(runs, x)
        if lost:
            runs, x, more = self.correct(runs, x)
            lost += more
        causes = sorted(causes + lost, key=lambda c: c.after / max(c.before, 1e-300))
        return Diagnosis(tuple(causes), tuple(runs))

    def correct(
        self, runs: list[Recording], x: np.ndarray
    ) -> tuple[list[Recording], np.ndarray, list[Cause]]:
        """Correct signs, column order and clocks as long as a correction halves the error."""
        causes: list[Cause] = []
        for _ in range(REPEATS):
            if (best := self.best(runs, x, self.error(runs, x))) is None:
                break
            cause, correction, x = best
            causes.append(cause)
            runs = [correction(run) for run in runs]
        return runs, x, causes

    def drop_bad_samples(
        self, runs: list[Recording], x: np.ndarray
    ) -> tuple[list[Recording], np.ndarray, list[Cause]]:
        """Drop samples of dead sensors and outliers, with a new fit after each step."""
        causes: list[Cause] = []
        for kind, seen_by in (("dead", self.find_dead), ("outliers", self.find_outliers)):
            shares: dict[tuple[str, str, int, str], float] = {}
            before, lost = self.error(runs, x), seen_by(runs, x)
            for _ in range(REPEATS):
                if not lost:
                    break
                runs = drop_samples(runs, lost)
                x = self.fit(runs, x)
                for at, rows in lost.items():
                    shares[at] = shares.get(at, 0.0) + 100 * float(rows.mean())
                lost = seen_by(runs, x)
            after = self.error(runs, x)
            for (run, sensor, _, column), share in shares.items():
                words = f"{run}: {share:.2g} % of the samples of {column} in channel {sensor} "
                words += WORDS[kind]
                causes.append(Cause(kind, (sensor,), (column,), before, after, words))
        return runs, x, causes

    def best(
        self, runs: list[Recording], x: np.ndarray, before: float
    ) -> tuple[Cause, Correction, np.ndarray] | None:
        """Return the correction whose fit has the least error, or None if no error is halved."""
        tried, fitted, at = [], [], (self.guess, x)
        uncorrected = [max(self.error(runs, y), 1e-300) for y in at]
        for order, one in enumerate(self.hypotheses(runs, x)):
            self.say(one.words)
            corrected = [one.correction(run) for run in runs]
            shares = [self.error(corrected, y) / e for y, e in zip(at, uncorrected, strict=True)]
            shares = [np.inf if np.isnan(share) else share for share in shares]  # inf / inf
            if not np.allclose(shares, 1.0, rtol=1e-6):  # skip without effect
                tried.append((min(shares), order, at[int(np.argmin(shares))], one))
        for _, order, y, one in sorted(tried, key=lambda trial: trial[0])[:TRIED]:
            self.say(f"fit: {one.words}")
            corrected = [one.correction(run) for run in runs]
            y = self.fit(corrected, y)
            helps = one.kind == "clock" and self.error(corrected, y) < before
            for rate in self.clock_rates(runs, y) if helps else ():
                one = self.refine_clock(runs, y, rate)
                corrected = [one.correction(run) for run in runs]
                y = self.fit(corrected, y)
            fitted.append((self.error(corrected, y), order, one, y))
        if not fitted or not (least := min(fit[0] for fit in fitted)) <= BETTER * before:
            return None
        # A mirrored motion has the same error: a rounding error must not choose.
        equal = sorted((fit for fit in fitted if fit[0] <= SAME * least), key=lambda fit: fit[1])
        after, _, (kind, channels, columns, correction, words), y = equal[0]
        words += f": with this corrected the error falls from {100 * before:.3g} % to "
        words += f"{100 * after:.3g} %"
        words += "".join(f"; the same error if {other.words} instead" for *_, other, _ in equal[1:])
        return Cause(kind, channels, columns, before, after, words), correction, y

    def hypotheses(self, runs: list[Recording], x: np.ndarray) -> Iterator[Hypothesis]:
        """Generate the possible mistakes of columns with large errors."""
        seen = self.traces(runs, self.guess)
        first = next(iter(seen.values()))
        doubted: dict[str, list[int]] = {}
        for sensor, errors in _by_column(seen).items():
            doubted[sensor] = np.flatnonzero(errors > SUSPECT).tolist()
        names = first["q"].names
        several = len(names) == self.model.nv  # columns of attitudes have no sign
        if HELD in runs[0].channels:
            columns = len(runs[0][HELD].names)
            one_each = columns == len(names) == self.model.nv
            doubted[HELD] = doubted["q"] if one_each else [*range(columns)] * bool(doubted["q"])
        groups = [(s,) for s in doubted] + ([("q", "v")] if "v" in doubted else [])
        for group in groups:
            if not several and "q" in group:
                continue
            columns_of = runs[0][group[0]].names if group[0] == HELD else first[group[0]].names
            where = " and ".join(group)
            among = sorted({*itertools.chain.from_iterable(doubted[s] for s in group)})
            for i in among:
                words = f"the sign of {columns_of[i]} in channel {where} is wrong"
                yield Hypothesis("sign", group, (columns_of[i],), flip(group, i), words)
            for i, j in itertools.combinations(among, 2):
                pair = columns_of[i], columns_of[j]
                words = f"{pair[0]} and {pair[1]} are swapped in channel {where}"
                yield Hypothesis("swap", group, pair, swap(group, i, j), words)
        sensors = tuple(s for s in first if s in doubted)
        for rate in self.clock_rates(runs, x):
            yield _clock_hypothesis(sensors, rate)

    def clock_rates(self, runs: Sequence[Recording], x: np.ndarray) -> list[float]:
        """Return a list with the clock rate of the sensors, empty if the clock is right."""

        def error(rate: float) -> float:
            corrected = [stretch(rate)(run) for run in runs]
            return min(self.error(corrected, y) for y in (self.guess, x))

        rates = {estimate_clock_rate(self.traces(runs, y)) for y in (self.guess, x)}
        return sorted((r for r in rates if abs(r) >= SLOW), key=error)[:1]

    def refine_clock(self, runs: Sequence[Recording], x: np.ndarray, rate: float) -> Hypothesis:
        """Refine a clock rate by the least error of a fit."""

        def square(rate: float) -> float:  # squared error, nearly a parabola in the rate
            corrected = [stretch(rate)(run) for run in runs]
            return self.error(corrected, self.fit(corrected, x)) ** 2

        found = optimize.minimize_scalar(
            square, bounds=(rate - NEAR, rate + NEAR), method="bounded",
            options={"xatol": SLOW / 40},
        )  # fmt: skip
        sensors = tuple(_by_column(self.traces(runs, x)))
        return _clock_hypothesis(sensors, found.x)

    def traces(self, runs: Sequence[Recording], x: np.ndarray) -> Traces:
        """Simulate recordings at parameters x, and return recorded and simulated values."""
        of = self.found.error.on(self.make_batch(runs))
        return make_traces(self.setup, of, np.append(x, np.zeros(of.size - len(x))), runs)

    def error(self, runs: Sequence[Recording], x: np.ndarray) -> float:
        """Compute the error e of recordings at parameters x, or inf if it is not finite."""
        errors = np.concatenate([*_by_column(self.traces(runs, x)).values()])
        found = float(np.sqrt(np.nanmean(errors**2)))
        return found if np.isfinite(found) else np.inf

    def fit(self, runs: Sequence[Recording], x: np.ndarray) -> np.ndarray:
        """Fit recordings in few steps from x, with columns divided by their standard deviations."""
        of = self.found.error.on(self.make_batch(runs))
        n = len(self.guess)
        rest = np.zeros(of.size - n)
        least = minimise(
            of, np.append(x[:n], rest), np.append(self.guess, rest), prior_weights=FIRST_WEIGHTS,
            max_evaluations=self.max_evaluations,
        )  # fmt: skip
        return least.x

    def make_batch(self, runs: Sequence[Recording]) -> Run:
        """Convert recordings to a batch, with columns weighted by 1 / standard deviation."""
        both = stack_runs([*map(self.make_run, runs), *self.longest])
        data: Run = jax.tree.map(lambda a: a[: len(runs)], both)
        weights = {}
        for sensor, values in data.values.items():
            there = np.asarray(data.weights[sensor]) > 0
            known = np.where(there, np.asarray(values), np.nan)
            spread = _spread(known.reshape(-1, known.shape[-1]))
            weights[sensor] = jnp.asarray(there / spread, values.dtype)
        return data._replace(weights=weights)

    def find_dead(self, runs: Sequence[Recording], x: np.ndarray) -> Lost:
        """Find long constant intervals of a sensor that no simulated motion explains."""
        lost: Lost = {}
        seen, fitted = self.traces(runs, self.guess), self.traces(runs, x)
        for run, sensor, trace in _each(seen):
            window = max(FEW, len(trace.t) // 40)
            for j, column in enumerate(trace.names):
                z, y = trace.recorded[:, j], trace.simulated[:, j]
                off = fitted[run][sensor].residual[:, j]
                quiet, parts = ndimage.label(_scatter(z, window) < QUIET * y.std())
                rows = np.zeros(len(z), bool)
                for part in range(1, parts + 1):
                    at = np.flatnonzero(quiet == part)
                    still = np.nanstd(z[at]) < MUCH * y[at].std()
                    still &= np.sqrt(np.nanmean(off[at] ** 2)) > 2 * np.nanstd(z[at])
                    if len(at) > DEAD * len(z) and still and y[at].std() > MUCH * y.std():
                        level, size = np.nanmedian(z[at]), np.nanmax(z[at]) - np.nanmin(z[at])
                        wide = slice(max(at[0] - window, 0), at[-1] + window)
                        rows[wide] |= np.abs(z[wide] - level) <= 2 * size
                rows[0] = False  # the start
                if rows.any():
                    lost[run, sensor, j, column] = rows
        return lost

    def find_outliers(self, runs: Sequence[Recording], x: np.ndarray) -> Lost:
        """Find samples with residuals far from the residuals of neighbouring samples."""
        lost: Lost = {}
        for run, sensor, trace in _each(self.traces(runs, x)):
            for j, column in enumerate(trace.names):
                r = trace.residual[:, j]
                known = np.flatnonzero(~np.isnan(r))
                if len(known) < FEW or np.ptp(r[known]) == 0:
                    continue
                away, scale = hampel(r[known], 0.0)
                rows = np.zeros(len(r), bool)
                rows[known[away > FAR * scale]] = True
                rows[0] = False  # the start
                if rows.any():
                    lost[run, sensor, j, column] = rows
        return lost


WORDS = {
    "outliers": 'are outliers; leave them out, or fit with loss="huber"',
    "dead": "stand still while the robot moves: the sensor is dead there; leave them out",
}


def _clock_hypothesis(sensors: tuple[str, ...], rate: float) -> Hypothesis:
    words = f"the clock of {' and '.join(sensors)} is {abs(100 * rate):.3g} % too "
    words += f"{'fast' if rate < 0 else 'slow'} compared with the clock of the commands"
    return Hypothesis("clock", sensors, (), stretch(rate), words)


def _each(seen: Traces) -> Iterator[tuple[str, str, Trace]]:
    """Iterate over (run, sensor, trace) of all sensors with enough samples."""
    for run, sensors in seen.items():
        for sensor, trace in sensors.items():
            if trace.measured:
                yield run, sensor, trace


def _by_column(seen: Traces) -> dict[str, np.ndarray]:
    """Compute the ratio of RMS error to standard deviation of each column, by sensor."""
    out: dict[str, np.ndarray] = {}
    for sensor in next(iter(seen.values())):
        recorded = np.concatenate([sensors[sensor].recorded for sensors in seen.values()])
        off = np.concatenate([sensors[sensor].residual for sensors in seen.values()])
        if (~np.isnan(recorded)).sum(0).min() >= FEW:
            out[sensor] = np.sqrt(np.nanmean(off**2, 0)) / _spread(recorded)
    return out


def _spread(values: np.ndarray) -> np.ndarray:
    """Return the standard deviations of columns, or the largest one for constant columns."""
    some = (~np.isnan(values)).sum(0) > 1
    spread = np.array([np.nanstd(x) if yes else 0.0 for x, yes in zip(values.T, some, strict=True)])
    return np.where(spread > 1e-9 * max(spread.max(), 1e-300), spread, spread.max() or 1.0)


def _scatter(x: np.ndarray, window: int) -> np.ndarray:
    """Compute the standard deviation in a window around each sample; inf for a missing sample."""
    known = np.nan_to_num(x - np.nanmean(x), nan=0.0)
    mean = ndimage.uniform_filter1d(known, window)
    variance = ndimage.uniform_filter1d(known**2, window) - mean**2
    return np.where(np.isnan(x), np.inf, np.sqrt(np.maximum(variance, 0.0)))
