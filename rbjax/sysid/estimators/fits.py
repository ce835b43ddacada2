"""The fits of `identify`, each from where the last one ended.

pieces      short pieces, each from its first sample: a start for a poor first guess
shooting    multiple shooting with growing continuity weights: a start for a long motion
growing     the first part of all recordings, then longer parts: a start for a poor first guess
whole       all recordings
weighed     the same, each column weighted by the noise of its residuals
finer       the same with shorter steps, if steps of half the length change the motion
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
from rbjax.sysid.data.recording import Recording, says_its_noise
from rbjax.sysid.estimators.fit_file import write_fit
from rbjax.sysid.estimators.fit_rows import samples_of
from rbjax.sysid.estimators.least_squares import PRIOR_WEIGHTS, Minimum, minimise
from rbjax.sysid.estimators.step_length import halved, over_noise, step_error
from rbjax.sysid.estimators.verdict import NORMAL, is_poor
from rbjax.sysid.parameters.guesses import drawn
from rbjax.sysid.parameters.unknowns import Unknowns
from rbjax.sysid.simulation.runs import Run, batch_of, run_of
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.shooting import TIES, Shooting
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.simulation.traces import Traces, together, traces

#: an rms below this fraction of a channel's spread is no noise
NOISELESS = 1e-7
#: prior weights of a fit to short pieces, which is only a start
FIRST_WEIGHTS = (1e-4, 1e-7)
#: parts of all recordings that a growing fit takes, one after the other
PARTS = (1 / 16, 1 / 8, 1 / 4, 1 / 2)
#: evaluations at most of a fit that is only a start
FEW_STEPS = 20
#: how far other first guesses are drawn, as in `many_starts`
SPREAD = 1.0
#: and are refined so often at most, before and after the fit
FINEST, REFINED = 16, 2


class Fitted(NamedTuple):
    """A fit of whole recordings: its residual, minimum and traces; estimated, whether it is weighed
    by noise that its residuals had before."""

    error: SimulationError
    least: Minimum
    traces: Traces
    estimated: bool = False


class Fits:
    """Fits of the same numbers to the same recordings.

    Fields: first, the first guess; prior, the value of numbers that the data do not identify;
    evaluations of residuals so far; notes, sentences on what was done by default.
    """

    def __init__(
        self, setup: Setup, sought: Unknowns, recordings: Sequence[Recording], grid: Grid, *,
        starts: bool | None, loss: str, steps: int, save: str | Path | None, say: Say,
    ):  # fmt: skip
        self.setup, self.sought, self.recordings, self.grid = setup, sought, recordings, grid
        self.starts, self.loss, self.steps, self.save, self.say = starts, loss, steps, save, say
        self.first = np.asarray(sought.read(setup), float)
        self.prior = self.first
        self.evaluations = 0
        self.notes: list[str] = []

    def pieces(self, x: np.ndarray, seconds: float) -> np.ndarray:
        """Numbers that suit pieces of this length."""
        short = [piece for run in self.recordings for piece in run.pieces(seconds)]
        least = self._fit(self._error(short), x, last=False, prior_weights=FIRST_WEIGHTS)
        return least.x[: self.shared]

    def shooting(self, x: np.ndarray, seconds: float) -> np.ndarray:
        """Numbers, and corrections of starts where these are sought, that suit pieces of this
        length which are one motion."""
        single = [run_of(self.setup, run, self.grid) for run in self.recordings]
        tied = Shooting(self.setup, self.sought, single, self.grid, seconds, loss=self.loss)
        for tied.tie in TIES:  # stiff ties must not make the prior's pull stronger
            weights = tuple(w / max(tied.tie, 1.0) ** 2 for w in FIRST_WEIGHTS)
            x = self._fit(tied, x, last=False, prior_weights=weights).x
        if not self._error(self.recordings).own:
            return x[: self.shared]
        # one chaotic motion is so steep that any pull to the first guess would lose it
        self.prior = tied.began(x)
        return self.prior

    def whole(self, x: np.ndarray) -> Fitted:
        """The fit of all recordings."""
        of = self._error(self.recordings)
        if of.own and x.size not in (self.shared, of.size):
            raise InputError(
                f"identify: resume holds {x.size - self.shared} corrections of initial states, "
                f"expected {of.size - self.shared} for {of.count} recordings; resume with the "
                "recordings that were fitted, or with the values alone (a dict name -> value)"
            )
        return self._fitted(of, x)

    def growing(self, of: SimulationError, x: np.ndarray) -> np.ndarray:
        """x of fits to the first part of all recordings, then to longer parts: over a short motion
        a poor guess stays near the minimum. The program is the same as for the whole."""
        T = max(float(np.max(t)) for t in of.runs.times.values())
        for part in PARTS:
            weights = {
                s: w * (of.runs.times[s] <= part * T)[..., None] for s, w in of.runs.weights.items()
            }
            some = of.on(of.runs._replace(weights=weights))
            if samples_of(some) <= 2 * some.size:
                continue
            x = self._fit(
                some, x, last=False, prior_weights=FIRST_WEIGHTS, max_evaluations=FEW_STEPS
            ).x
        return x

    def improved(self, fitted: Fitted, restarts: int) -> Fitted:
        """The fit. If it is poor, the best of it, a growing fit from the first guess, and growing
        fits from other guesses."""
        why = "the first guess failed" if not np.isfinite(fitted.least.cost) else ""
        why = why or self._why_poor(fitted)
        if not (why and restarts):
            return fitted
        of, best, tried, won = fitted.error, fitted, 0, "the first guess is still the best"
        for k, guess in enumerate(self._guesses(restarts)):
            x = self.growing(of, np.append(guess, np.zeros(of.size - self.shared)))
            # a long motion is so steep that a pull to the first guess would lose what has grown
            other = self._fitted(of, x, prior=x)
            tried = k + 1
            if other.least.cost < best.least.cost * (1 - 1e-6):
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

    def _why_poor(self, fitted: Fitted) -> str:
        robust = self.loss == "huber"
        return is_poor(fitted.traces, self.recordings, self.setup, robust=robust)

    def _guesses(self, count: int) -> np.ndarray:
        """Guesses (count, n), beginning with the first guess."""
        try:
            return drawn(self.sought, self.setup, count, SPREAD, 0)
        except InputError:  # an unknown of a kind that cannot be drawn
            return self.first[None]

    def weighed(self, fitted: Fitted) -> Fitted:
        """The fit again, weighed by the noise of its residuals; itself where that is no noise, or
        all channels say their own."""
        robust = self.loss == "huber"
        data = _weighed(fitted.error.runs, fitted.traces, self.recordings, robust=robust)
        if data is None:
            return fitted
        of = fitted.error.on(data)
        return self._refitted(of, fitted.least.x)._replace(estimated=True)

    def stepped(self) -> None:
        """Shorten the steps until their error at the first guess is below the noise that the
        recordings show: longer steps may hide the right minimum."""
        of = self._error(self.recordings)
        x = np.append(self.first, np.zeros(of.size - self.shared))
        first, over, done = self.grid, 0.0, 1
        while done < FINEST:
            other = self._error(self.recordings, halved(self.grid))
            e = other.residuals(x) - of.residuals(x)
            now = over_noise(of, e, self.recordings)
            over = max(over, now)
            if not now > 1:
                break
            # an error of order 4 falls by 16 if the step is halved
            again = 2 if now > 16 and 4 * done <= FINEST else 1
            self.grid = halved(self.grid, again)
            done *= 2**again
            of = other if again == 1 else self._error(self.recordings)
        self._say_steps(first, over)

    def _say_steps(self, first: Grid, error: float) -> None:
        if self.grid != first:
            why = "the search stalled"
            if error > 1:
                why = f"their error is {error:.2g} times what matters"
            self.notes.append(
                f"steps of {first.period / first.substeps:.3g} s were too long ({why}), so the "
                "motion has steps of "
                f"{self.grid.period / self.grid.substeps:.3g} s; grid= sets them"
            )

    def finer(self, fitted: Fitted) -> Fitted:
        """The fit with steps so short that steps of half their length change no number by a part
        of its standard deviation that matters. A search that stalls is another sign of long steps:
        where friction changes its sign within a step, the error is rough."""
        first, worst, best, needed = self.grid, 0.0, fitted, False
        for _ in range(REFINED):
            other = self._finer(best)
            error, matters = step_error(best, other)
            if not matters and best.least.success:
                break
            found = self._refitted(other, best.least.x)
            if found.least.cost > 2 * best.least.cost:  # recordings were made with these steps
                break
            worst, needed = max(worst, error), needed or matters or found.least.success
            best = found._replace(estimated=fitted.estimated)
        if not needed:
            return fitted
        self.grid = best.error.grid
        self._say_steps(first, worst)
        return best

    def _finer(self, fitted: Fitted) -> SimulationError:
        of = self._error(self.recordings, halved(fitted.error.grid))
        return of.on(of.runs._replace(weights=fitted.error.runs.weights))

    @property
    def shared(self) -> int:
        """How many numbers are sought, without corrections of starts."""
        return len(self.first)

    def _error(self, recordings: Sequence[Recording], grid: Grid | None = None) -> SimulationError:
        grid = self.grid if grid is None else grid
        data = batch_of(self.setup, recordings, grid)
        return SimulationError(
            self.setup, self.sought, data, grid, starts=self.starts, loss=self.loss
        )

    def _fitted(self, of: SimulationError, x: np.ndarray, **how: Any) -> Fitted:
        least = self._fit(of, x, **how)
        return Fitted(of, least, traces(self.setup, of, least.x, self.recordings))

    def _refitted(self, of: SimulationError, x: np.ndarray) -> Fitted:
        """A fit from x, the minimum of a residual that is nearly the same: numbers that the data
        leave open are where they belong, and any pull to the first guess could only lose it."""
        return self._fitted(of, x, prior=x, prior_weights=PRIOR_WEIGHTS[-1:])

    def _fit(
        self, of: SimulationError | Shooting, x: np.ndarray, *, last: bool = True,
        prior: np.ndarray | None = None, **how: Any,
    ) -> Minimum:  # fmt: skip
        self.say("simulating")
        prior = self.prior if prior is None else prior
        x, near = (np.append(a, np.zeros(of.size))[: of.size] for a in (x, prior))
        slopes = of.triangle(x)
        if last:
            check_moves(self.sought, slopes[:, : self.shared])
        least_cost = np.inf
        most = how.pop("max_evaluations", self.steps)

        def watch(k: int, cost: float, x: np.ndarray) -> None:
            nonlocal least_cost
            self.say(f"evaluation {k} of at most {most}, squares {cost:.4g}")
            if self.save is not None and cost < least_cost:
                least_cost = cost
                kept = x if last else x[: self.shared]  # the starts of pieces serve no other fit
                write_fit(self.save, self.sought.names, kept, ok=False, message="not ended")

        least = minimise(of, x, near, triangle=slopes, max_evaluations=most, watch=watch, **how)
        self.evaluations += least.evaluations
        return least


def _weighed(data: Run, seen: Traces, runs: Sequence[Recording], *, robust: bool) -> Run | None:
    """The data weighed by the noise of the residuals, where no channel says its own; None where
    all say it, or there is none. Outliers do not count for `robust`."""
    weights, changed = dict(data.weights), False
    for sensor in data.values:
        if says_its_noise(runs, sensor):
            continue
        r, spread = together(seen, sensor), np.asarray(data.values[sensor]).std(axis=(0, 1))
        if (~np.isnan(r)).sum(0).max() <= len(runs):  # only the starts, which are no measurement
            continue
        unseen = np.isnan(r).all(0)
        r = np.where(unseen, 1.0, r)
        sigma = NORMAL * np.nanmedian(np.abs(r), 0) if robust else root_mean_square(r)
        sigma = next(iter(seen.values()))[sensor].columns.noise(sigma)
        if not (sigma > NOISELESS * spread).all():
            return None
        weights[sensor] = jnp.asarray((np.asarray(weights[sensor]) > 0) / sigma)
        changed = True
    return data._replace(weights=weights) if changed else None


def check_moves(sought: Unknowns, J: np.ndarray) -> None:
    """`InputError` for an unknown that has no effect on any reading."""
    ends = np.cumsum(sought.sizes)
    largest, still = np.abs(J).max(), rank_tolerance("unknown without effect", J.dtype)
    for (name, u), end, size in zip(sought.members.items(), ends, sought.sizes, strict=True):
        if np.isfinite(largest) and not np.abs(J[:, end - size : end]).max() > still * largest:
            raise InputError(
                f"identify: {name} ({u!r}) moves nothing that was recorded, expected unknowns that "
                "do: leave it out, or record a motion or a sensor that shows it"
            )
