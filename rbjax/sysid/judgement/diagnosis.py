"""`diagnose`: what is wrong with the data, from the motion that the model expects.

Each cause is a hypothesis with its mend: turn a sign, swap two columns, stretch a clock, leave out
samples. A mend that explains the data is worth a fit to the mended data; a cause is named if that
fit errs at most half as much as the one without. The error is that of all columns, each over its
own spread:

    e^2 = mean over columns of  mean (simulated - recorded)^2 / var(recorded)
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from scipy import ndimage, optimize

from rbjax.arguments import integer
from rbjax.progress import Say, progress_line
from rbjax.sysid.arguments import check_kind
from rbjax.sysid.data.corrections import Lost, Mend, flip, stretch, swap, without
from rbjax.sysid.data.recording import HELD, Recording
from rbjax.sysid.data.recording_checks import FAR, hampel
from rbjax.sysid.estimators.fits import FIRST_WEIGHTS
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.estimators.least_squares import minimise
from rbjax.sysid.judgement.clocks import rate_of
from rbjax.sysid.simulation.runs import Run, batch, ordered, run_of
from rbjax.sysid.simulation.traces import FEW, Trace, Traces, traces
from rbjax.sysid.statistics.precision import in_double

BETTER = 0.5  # error with a mend over that without, at which the cause is named
SUSPECT = 0.3  # error of a column over its spread from which on its sign and place are doubted
TRIED = 3  # mends that are worth a fit, the best of all
NEAR, SLOW = 0.01, 2e-3  # a clock's rate is sought so near to the first one; the least named
#: share of a recording during which a dead sensor stands still, within a part of the motion that
#: is expected there, which must be much of the whole
DEAD, QUIET, MUCH = 0.1, 0.02, 0.2
REPEATS = 3  # of mending and fitting again


@dataclass(frozen=True)
class Cause:
    """One thing that is wrong: its kind ("sign", "swap", "clock", "outliers" or "dead"), the
    channels and columns, the error before and after its mend, and a sentence."""

    kind: str
    channels: tuple[str, ...]
    columns: tuple[str, ...]
    before: float
    after: float
    sentence: str

    def __str__(self) -> str:
        return self.sentence


@dataclass(frozen=True)
class Diagnosis:
    """Causes, those that explain most first; and the recordings with all of them mended."""

    causes: tuple[Cause, ...]
    recordings: tuple[Recording, ...]

    def summary(self) -> str:
        """A sentence for each cause."""
        none = "no flipped sign, swapped joint, wrong clock, outlier or dead sensor explains the "
        return "\n".join(map(str, self.causes)) or none + "error"


@in_double
def diagnose(found: Identified, *, steps: int = 15, progress: bool = False) -> Diagnosis:
    """Find what is wrong with the data of a fit.

    Args:
        found: what `identify` gave; its first guess must explain most of the motion.
        steps: evaluations at most of each fit that tries a mend.
        progress: whether a line shows the progress.

    Returns:
        `Diagnosis`: fit its recordings, or correct the log.

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
    check_kind("diagnose", "found", found, Identified, "the result of `identify`")
    integer("diagnose", "steps", steps, least=1)
    with progress_line("diagnose", progress) as say:
        return _Bench(found, steps, say).diagnosis()


class _Bench:
    """Trials of mends with one compiled simulation."""

    def __init__(self, found: Identified, steps: int, say: Say):
        self.found, self.steps, self.say = found, steps, say
        self.model, self.setup = found.error.setup.model, found.error.setup
        self.guess = np.array([*found.guess.values()])
        self.longest = [self.run_of(ordered(self.model, run)) for run in found.recordings]

    def diagnosis(self) -> Diagnosis:
        runs = [ordered(self.model, run) for run in self.found.recordings]
        x = np.array([*self.found.values.values()])
        x = min((x, self.guess), key=lambda y: self.error(runs, y))
        runs, x, causes = self.mended(runs, x)
        runs, x, lost = self.left_out(runs, x)
        if lost:
            runs, x, more = self.mended(runs, x)
            lost += more
        causes = sorted(causes + lost, key=lambda c: c.after / max(c.before, 1e-300))
        return Diagnosis(tuple(causes), tuple(runs))

    def mended(
        self, runs: list[Recording], x: np.ndarray
    ) -> tuple[list[Recording], np.ndarray, list[Cause]]:
        """Signs, places and clocks, as long as another mend explains much more."""
        causes: list[Cause] = []
        for _ in range(REPEATS):
            best = self.best(runs, x, self.error(runs, x))
            if best is None:
                break
            cause, mend, x = best
            causes.append(cause)
            runs = [mend(run) for run in runs]
        return runs, x, causes

    def left_out(
        self, runs: list[Recording], x: np.ndarray
    ) -> tuple[list[Recording], np.ndarray, list[Cause]]:
        """Samples that are no measurement; a better fit shows more of them."""
        causes: list[Cause] = []
        for kind, seen_by in (("dead", self.dead), ("outliers", self.outliers)):
            shares: dict[tuple[str, str, int, str], float] = {}
            before, lost = self.error(runs, x), seen_by(runs, x)
            for _ in range(REPEATS):
                if not lost:
                    break
                runs = without(runs, lost)
                x = self.fitted(runs, x)
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
    ) -> tuple[Cause, Mend, np.ndarray] | None:
        """The mend after which a fit errs least, if it is a cause. Worth a fit are those after
        which the same numbers err least beside before: at numbers that were fitted to wrong data
        every mend is a change for the worse, and the first guess errs more."""
        tried = []
        at = (self.guess, x)
        unmended = [max(self.error(runs, y), 1e-300) for y in at]
        for kind, channels, columns, mend, words in self.hypotheses(runs, x):
            self.say(words)
            mended = [mend(run) for run in runs]
            shares = [self.error(mended, y) / e for y, e in zip(at, unmended, strict=True)]
            shares = [np.inf if np.isnan(share) else share for share in shares]  # inf / inf
            if not np.allclose(shares, 1.0, rtol=1e-6):  # of two commands that are alike
                k = int(np.argmin(shares))
                tried.append((shares[k], k, kind, channels, columns, mend, words))
        tried.sort(key=lambda one: one[0])
        fitted = []
        for _, k, kind, channels, columns, mend, words in tried[:TRIED]:
            self.say(f"fit: {words}")
            mended = [mend(run) for run in runs]
            y = self.fitted(mended, at[k])
            helps = kind == "clock" and self.error(mended, y) < before
            for rate in self.rate(runs, y) if helps else ():  # one, or none that is still seen
                mend, words = self.clock(runs, y, rate)
                mended = [mend(run) for run in runs]
                y = self.fitted(mended, y)
            fitted.append((self.error(mended, y), kind, channels, columns, mend, words, y))
        if not fitted:
            return None
        after, kind, channels, columns, mend, words, y = min(fitted, key=lambda one: one[0])
        if not after <= BETTER * before:
            return None
        words += f": with this mended the error falls from {_percent(before)} to {_percent(after)}"
        return Cause(kind, channels, columns, before, after, words), mend, y

    def hypotheses(
        self, runs: list[Recording], x: np.ndarray
    ) -> Iterator[tuple[str, tuple[str, ...], tuple[str, ...], Mend, str]]:
        """Kind, channels, columns, mend and words of what could be wrong."""
        seen = self.traces(runs, self.guess)
        first = next(iter(seen.values()))
        doubted: dict[str, list[int]] = {}
        for sensor, errors in _by_column(seen).items():
            doubted[sensor] = np.flatnonzero(errors > SUSPECT).tolist()
        names = first["q"].names
        several = len(names) == self.model.nv  # no attitudes, whose numbers have no sign
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
                yield "sign", group, (columns_of[i],), flip(group, i), (
                    f"the sign of {columns_of[i]} in channel {where} is wrong"
                )  # fmt: skip
            for i, j in itertools.combinations(among, 2):
                pair = columns_of[i], columns_of[j]
                yield "swap", group, pair, swap(group, i, j), (
                    f"{pair[0]} and {pair[1]} are swapped in channel {where}"
                )  # fmt: skip
        sensors = tuple(s for s in first if s in doubted)
        for rate in self.rate(runs, x):
            yield "clock", sensors, (), stretch(rate), _of_clock(sensors, rate)

    def rate(self, runs: Sequence[Recording], x: np.ndarray) -> list[float]:
        """The rate of the sensors' clock, none if it is right. Numbers that were fitted to a wrong
        clock hide it, so the first guess is asked as well."""

        def error(rate: float) -> float:
            mended = [stretch(rate)(run) for run in runs]
            return min(self.error(mended, y) for y in (self.guess, x))

        rates = {rate_of(self.traces(runs, y)) for y in (self.guess, x)}
        return sorted((r for r in rates if abs(r) >= SLOW), key=error)[:1]

    def clock(self, runs: Sequence[Recording], x: np.ndarray, rate: float) -> tuple[Mend, str]:
        """The rate near to one at which the fit errs least: parameters can hide a part of a wrong
        one."""

        def square(rate: float) -> float:  # of the error: nearly a parabola
            mended = [stretch(rate)(run) for run in runs]
            return self.error(mended, self.fitted(mended, x)) ** 2

        found = optimize.minimize_scalar(
            square, bounds=(rate - NEAR, rate + NEAR), method="bounded",
            options={"xatol": SLOW / 40},
        )  # fmt: skip
        sensors = tuple(_by_column(self.traces(runs, x)))
        return stretch(found.x), _of_clock(sensors, found.x)

    def traces(self, runs: Sequence[Recording], x: np.ndarray) -> Traces:
        of = self.found.error.on(self.batched(runs))
        return traces(self.setup, of, np.append(x, np.zeros(of.size - len(x))), runs)

    def error(self, runs: Sequence[Recording], x: np.ndarray) -> float:
        errors = np.concatenate([*_by_column(self.traces(runs, x)).values()])
        found = float(np.sqrt(np.nanmean(errors**2)))
        return found if np.isfinite(found) else np.inf

    def fitted(self, runs: Sequence[Recording], x: np.ndarray) -> np.ndarray:
        """x of a short fit, every column weighed by its spread: numbers, and corrections of
        starts."""
        of = self.found.error.on(self.batched(runs))
        n = len(self.guess)
        rest = np.zeros(of.size - n)
        least = minimise(
            of, np.append(x[:n], rest), np.append(self.guess, rest), prior_weights=FIRST_WEIGHTS,
            max_evaluations=self.steps,
        )  # fmt: skip
        return least.x

    def run_of(self, run: Recording) -> Run:
        return run_of(self.setup, run, self.found.grid)

    def batched(self, runs: Sequence[Recording]) -> Run:
        """The runs as one, of the shape of those that were fitted, every column weighed by its
        spread."""
        both = batch([*map(self.run_of, runs), *self.longest])
        data: Run = jax.tree.map(lambda a: a[: len(runs)], both)
        weights = {}
        for sensor, values in data.values.items():
            there = np.asarray(data.weights[sensor]) > 0
            known = np.where(there, np.asarray(values), np.nan)
            spread = _spread(known.reshape(-1, known.shape[-1]))
            weights[sensor] = jnp.asarray(there / spread, values.dtype)
        return data._replace(weights=weights)

    def dead(self, runs: Sequence[Recording], x: np.ndarray) -> Lost:
        """Samples that stand still for long while the first guess moves, and that no fit
        explains."""
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

    def outliers(self, runs: Sequence[Recording], x: np.ndarray) -> Lost:
        """Samples whose residuals are far from those of their neighbours."""
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


def _of_clock(sensors: tuple[str, ...], rate: float) -> str:
    return (
        f"the clock of {' and '.join(sensors)} is {abs(100 * rate):.3g} % too "
        f"{'fast' if rate < 0 else 'slow'} beside that of the commands"
    )


def _each(seen: Traces) -> Iterator[tuple[str, str, Trace]]:
    """Run, sensor and trace of all sensors with enough samples."""
    for run, sensors in seen.items():
        for sensor, trace in sensors.items():
            if trace.measured:
                yield run, sensor, trace


def _by_column(seen: Traces) -> dict[str, np.ndarray]:
    """By sensor with enough samples, the error of each column over its spread."""
    out: dict[str, np.ndarray] = {}
    for sensor in next(iter(seen.values())):
        recorded = np.concatenate([sensors[sensor].recorded for sensors in seen.values()])
        off = np.concatenate([sensors[sensor].residual for sensors in seen.values()])
        if (~np.isnan(recorded)).sum(0).min() >= FEW:
            out[sensor] = np.sqrt(np.nanmean(off**2, 0)) / _spread(recorded)
    return out


def _spread(values: np.ndarray) -> np.ndarray:
    """Standard deviations of columns; of those that stand still, the largest of all."""
    some = (~np.isnan(values)).sum(0) > 1
    spread = np.array([np.nanstd(x) if yes else 0.0 for x, yes in zip(values.T, some, strict=True)])
    return np.where(spread > 1e-9 * max(spread.max(), 1e-300), spread, spread.max() or 1.0)


def _scatter(x: np.ndarray, window: int) -> np.ndarray:
    """The standard deviation around each sample; that of samples that did not arrive is inf."""
    known = np.nan_to_num(x - np.nanmean(x), nan=0.0)
    mean = ndimage.uniform_filter1d(known, window)
    variance = ndimage.uniform_filter1d(known**2, window) - mean**2
    return np.where(np.isnan(x), np.inf, np.sqrt(np.maximum(variance, 0.0)))


def _percent(error: float) -> str:
    return f"{100 * error:.3g} %"
