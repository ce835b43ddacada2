"""`Identified`: what recordings say of a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

from rbjax.errors import UnknownName
from rbjax.model import Model
from rbjax.sysid.arguments import recordings_of
from rbjax.sysid.data.recording import HELD, Recording
from rbjax.sysid.estimators.fit_file import write_fit
from rbjax.sysid.estimators.free_running import free_run
from rbjax.sysid.estimators.verdict import Verdict, without_outliers
from rbjax.sysid.simulation.setup import Grid, Setup
from rbjax.sysid.simulation.simulation_error import SimulationError
from rbjax.sysid.simulation.traces import Traces, rms_of
from rbjax.sysid.statistics.comparisons import HeldOut, held_out
from rbjax.sysid.statistics.fit_statistics import FitStatistics
from rbjax.sysid.statistics.intervals import Estimates
from rbjax.sysid.statistics.precision import in_double
from rbjax.sysid.statistics.rank import Combinations


class Options(NamedTuple):
    """The options of a fit, as the arguments of `identify`."""

    grid: Grid | None = None
    pieces: float | None = None
    shooting: float | None = None
    starts: bool | None = None
    loss: str = "squares"
    steps: int = 100
    restarts: int = 4


@dataclass(frozen=True)
class Identified:
    """The result of an identification.

    Fields:
        setup: with the estimated numbers.
        values, guess: the estimates and the first guess, by name.
        identifiable: the combinations of the unknowns that the data identify; `found.summary()`.
        estimates: values, covariance and intervals.
        recordings: those that were fitted.
        traces: recorded and simulated values.
        evaluations: of the residual.
        success, message: whether the fit converged.
        grid: of the simulation.
        error: the simulation error, in float64.
        noisy: whether the noise of all channels is known.
        statistics: of the residuals.
        verdict: whether the fit is good, and each check that fails.
        notes: sentences on what was done by default, such as other starts and shorter steps.
        options: of the fit.
    """

    setup: Setup
    values: dict[str, float]
    guess: dict[str, float]
    identifiable: Combinations
    estimates: Estimates
    recordings: tuple[Recording, ...]
    traces: Traces
    evaluations: int
    success: bool
    message: str
    grid: Grid
    error: SimulationError
    noisy: bool
    statistics: FitStatistics
    verdict: Verdict
    notes: tuple[str, ...]
    options: Options

    @property
    def model(self) -> Model:
        """The model with the found numbers."""
        return self.setup.model

    def summary(self) -> str:
        """Whether the fit converged and is good, what was done by default, and each number with
        its 95 % interval, one sentence a line."""
        first = [f"{self.message} in {self.evaluations} evaluations", self.verdict.sentence]
        names = range(len(self.values))
        return "\n".join([*first, *self.notes, *(self.estimates.sentences()[k] for k in names)])

    @property
    def rms(self) -> dict[str, np.ndarray]:
        """By sensor, the error of the simulation, one number a column."""
        return rms_of(self.traces)

    def save(self, path: str | Path) -> None:
        """Writes values, intervals and errors as JSON; `identify(..., resume=path)` goes on."""
        intervals = {name: self.estimates.interval(name) for name in self.values}
        write_fit(
            path, list(self.values), self.estimates.values, ok=self.success, message=self.message,
            guess=self.guess, evaluations=self.evaluations,
            sigma={n: x.sigma if np.isfinite(x.sigma) else None for n, x in intervals.items()},
            rms={sensor: rms.tolist() for sensor, rms in self.rms.items()},
        )  # fmt: skip

    @in_double
    def _in_double(self) -> Setup:
        """The set-up with the estimates in float64."""
        of = self.error
        p = jnp.asarray(self.estimates.values[: of.shared])
        found: Setup = of.unknowns.write(of.setup, p)
        return found

    @in_double
    def simulated(self, recordings: Sequence[Recording], *, starts: bool | None = None) -> Traces:
        """Simulate other recordings from their first samples or, with `starts`, from the initial
        states that fit them best (`free_run`). None: as in the fit."""
        recordings = recordings_of("simulated", recordings)
        if starts is None and self.options.starts is not None:
            starts = self.options.starts
        setup = self._in_double()
        columns = {sensor: setup.columns(sensor) for sensor in self.rms}
        sigma = {sensor: columns[sensor].noise(rms) for sensor, rms in self.rms.items()}
        noise = {sensor: np.where(rms > 0, rms, 1.0) for sensor, rms in sigma.items()}
        return free_run(setup, recordings, grid=self.grid, starts=starts, noise=noise)

    @property
    def judged(self) -> str:
        """The sensor by whose error the fit is judged: "q", or where only its start was recorded
        the first that was and that an unknown moves."""
        sensors = next(iter(self.traces.values()))
        if sensors["q"].measured:
            return "q"
        still = self.unmoved
        return next((s for s in sensors if sensors[s].measured and s not in still), "q")

    @property
    @in_double
    def unmoved(self) -> tuple[str, ...]:
        """Sensors whose readings no unknown changes: they contain no information on them."""
        still = self.error.unmoved(self.estimates.values)
        seen = self.traces.values()
        return tuple(s for s in still if any(sensors[s].measured for sensors in seen))

    @property
    def left_out(self) -> tuple[str, ...]:
        """Channels that were recorded and not fitted, as the set-up has no such sensor."""
        recorded = dict.fromkeys(channel for run in self.recordings for channel in run)
        return tuple(s for s in recorded if s not in self.error.runs.values and s != HELD)

    def on(
        self,
        recordings: Sequence[Recording],
        *,
        starts: bool | None = None,
        sensor: str | None = None,
    ) -> HeldOut:
        """The verdict on recordings that the fit never saw, simulated as `simulated` does, by the
        error of a sensor (None: `judged`); without outliers if the fit is robust (loss="huber").

        Raises:
            InputError: a recording that was fitted.
            UnknownName: a sensor that was not fitted.
        """
        recordings = recordings_of("on", recordings)
        sensor = self.judged if sensor is None else sensor
        if sensor not in self.rms:
            raise UnknownName("sensor", sensor, self.rms)
        seen, unseen = self.traces, self.simulated(recordings, starts=starts)
        if self.options.loss == "huber":
            seen, unseen = (without_outliers(x)[0] for x in (seen, unseen))
        return held_out(
            {name: sensors[sensor].residual for name, sensors in seen.items()},
            {name: sensors[sensor].residual for name, sensors in unseen.items()},
            measured={name: sensors[sensor].recorded for name, sensors in unseen.items()},
            noise=_stated(recordings, sensor),
            unit=self.setup.unit(sensor),
        )


def _stated(recordings: Sequence[Recording], sensor: str) -> float | None:
    """The stated noise of a sensor, the root mean square of its columns; None if it is not."""
    noise = [run[sensor].noise for run in recordings if sensor in run.channels]
    if not noise or any(sigma is None for sigma in noise):
        return None
    return float(np.sqrt(np.mean(np.concatenate(noise) ** 2)))
