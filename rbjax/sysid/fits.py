"""The fits of `identify`, each from where the last one ended.

    pieces      short pieces, each from its first sample: a start for a poor first guess
    shooting    pieces that are tied, end to start, ever more stiffly: a start for a long motion
    whole       all recordings
    weighed     the same, each column weighed by the noise of its residuals
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax.errors import InputError
from rbjax.progress import Say
from rbjax.sysid.columns import root_mean_square
from rbjax.sysid.fit_file import write_fit
from rbjax.sysid.least_squares import Minimum, minimise
from rbjax.sysid.recording import Recording
from rbjax.sysid.runs import Run, batch_of, run_of
from rbjax.sysid.shooting import TIES, Shooting
from rbjax.sysid.simulation import Grid, Setup
from rbjax.sysid.simulation_error import SimulationError
from rbjax.sysid.traces import Traces, together, traces
from rbjax.sysid.unknowns import Unknowns

#: an rms below this fraction of a channel's spread is no noise
NOISELESS = 1e-7
#: standard deviation of normal noise over the median of its size
NORMAL = 1.4826
#: pulls of the fit to short pieces, which is only a start
FIRST_PULLS = (1e-4, 1e-7)


class Fitted(NamedTuple):
    """A fit of whole recordings: its residual, minimum and traces; estimated, whether it is weighed
    by noise that its residuals had before."""

    error: SimulationError
    least: Minimum
    traces: Traces
    estimated: bool = False


class Fits:
    """Fits of the same numbers to the same recordings.

    Fields: first, the first guess; prior, to which the next fit is pulled where data leave numbers
    open; evaluations of residuals so far.
    """

    def __init__(
        self, setup: Setup, sought: Unknowns, recordings: Sequence[Recording], grid: Grid, *,
        starts: bool, loss: str, steps: int, save: str | Path | None, say: Say,
    ):  # fmt: skip
        self.setup, self.sought, self.recordings, self.grid = setup, sought, recordings, grid
        self.starts, self.loss, self.steps, self.save, self.say = starts, loss, steps, save, say
        self.first = np.asarray(sought.read(setup), float)
        self.prior = self.first
        self.evaluations = 0

    def pieces(self, x: np.ndarray, seconds: float) -> np.ndarray:
        """Numbers that suit pieces of this length."""
        short = [piece for run in self.recordings for piece in run.pieces(seconds)]
        return self._fit(self._error(short), x, last=False, pulls=FIRST_PULLS).x[: self.shared]

    def shooting(self, x: np.ndarray, seconds: float) -> np.ndarray:
        """Numbers, and corrections of starts where these are sought, that suit pieces of this
        length which are one motion."""
        single = [run_of(self.setup, run, self.grid) for run in self.recordings]
        tied = Shooting(self.setup, self.sought, single, self.grid, seconds, loss=self.loss)
        for tied.tie in TIES:  # stiff ties must not make the prior's pull stronger
            pulls = tuple(w / max(tied.tie, 1.0) ** 2 for w in FIRST_PULLS)
            x = self._fit(tied, x, last=False, pulls=pulls).x
        if not self.starts:
            return x[: self.shared]
        # one chaotic motion is so steep that any pull to the first guess would lose it
        self.prior = tied.began(x)
        return self.prior

    def whole(self, x: np.ndarray) -> Fitted:
        """The fit of all recordings."""
        return self._fitted(self._error(self.recordings), x)

    def weighed(self, fitted: Fitted) -> Fitted:
        """The fit again, weighed by the noise of its residuals; itself where that is no noise, or
        all channels say their own."""
        robust = self.loss == "huber"
        data = _weighed(fitted.error.runs, fitted.traces, self.recordings, robust=robust)
        if data is None:
            return fitted
        return self._fitted(fitted.error.on(data), fitted.least.x)._replace(estimated=True)

    @property
    def shared(self) -> int:
        """How many numbers are sought, without corrections of starts."""
        return len(self.first)

    def _error(self, recordings: Sequence[Recording]) -> SimulationError:
        data = batch_of(self.setup, recordings, self.grid)
        return SimulationError(
            self.setup, self.sought, data, self.grid, starts=self.starts, loss=self.loss
        )

    def _fitted(self, of: SimulationError, x: np.ndarray) -> Fitted:
        least = self._fit(of, x)
        return Fitted(of, least, traces(self.setup, of, least.x, self.recordings))

    def _fit(
        self, of: SimulationError | Shooting, x: np.ndarray, *, last: bool = True, **how: Any
    ) -> Minimum:
        self.say("simulating")
        x, near = (np.append(a, np.zeros(of.size))[: of.size] for a in (x, self.prior))
        slopes = of.triangle(x)
        check_moves(self.sought, slopes[:, : self.shared])
        least_cost = np.inf

        def watch(k: int, cost: float, x: np.ndarray) -> None:
            nonlocal least_cost
            self.say(f"evaluation {k} of at most {self.steps}, squares {cost:.4g}")
            if self.save is not None and cost < least_cost:
                least_cost = cost
                kept = x if last else x[: self.shared]  # the starts of pieces serve no other fit
                write_fit(self.save, self.sought.names, kept, ok=False, message="not ended")

        least = minimise(of, x, near, triangle=slopes, steps=self.steps, watch=watch, **how)
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


def says_its_noise(runs: Sequence[Recording], sensor: str) -> bool:
    return all(run[sensor].noise is not None for run in runs)


def check_moves(sought: Unknowns, J: np.ndarray) -> None:
    """`InputError` for an unknown none of whose numbers moves anything."""
    ends = np.cumsum(sought.sizes)
    largest = np.abs(J).max()
    for (name, u), end, size in zip(sought.members.items(), ends, sought.sizes, strict=True):
        if np.isfinite(largest) and not np.abs(J[:, end - size : end]).max() > 1e-12 * largest:
            raise InputError(
                f"identify: {name} ({u!r}) moves nothing that was recorded, expected unknowns that "
                "do: leave it out, or record a motion or a sensor that shows it"
            )
