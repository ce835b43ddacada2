"""`Identified`: what recordings say of a robot."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbjax.errors import UnknownName
from rbjax.model import Model
from rbjax.sysid.comparison import HeldOut, held_out
from rbjax.sysid.fit_file import write_fit
from rbjax.sysid.free_run import free_run
from rbjax.sysid.rank import Combinations
from rbjax.sysid.recording import HELD, Recording
from rbjax.sysid.simulation import Grid, Setup
from rbjax.sysid.simulation_error import SimulationError
from rbjax.sysid.statistics import Estimates
from rbjax.sysid.traces import Traces, rms_of


@dataclass(frozen=True)
class Identified:
    """What recordings say of a robot.

    Fields: setup with the found numbers; values by name; guess, the first ones; found, the
    combinations of them that the data show, `found.words()`; estimates, their covariance and
    intervals; recordings that were fitted, and traces, what they recorded beside what is simulated;
    evaluations of the residual; ok and message, whether the fit converged; error, the simulation;
    noisy, whether the noise of all channels is known.
    """

    setup: Setup
    values: dict[str, float]
    guess: dict[str, float]
    found: Combinations
    estimates: Estimates
    recordings: tuple[Recording, ...]
    traces: Traces
    evaluations: int
    ok: bool
    message: str
    grid: Grid
    error: SimulationError
    noisy: bool

    @property
    def model(self) -> Model:
        """The model with the found numbers."""
        return self.setup.model

    @property
    def rms(self) -> dict[str, np.ndarray]:
        """By sensor, the error of the simulation, one number a column."""
        return rms_of(self.traces)

    def save(self, path: str | Path) -> None:
        """Writes values, intervals and errors as JSON; `identify(..., resume=path)` goes on."""
        intervals = {name: self.estimates.interval(name) for name in self.values}
        write_fit(
            path, list(self.values), self.estimates.values, ok=self.ok, message=self.message,
            guess=self.guess, evaluations=self.evaluations,
            sigma={n: x.sigma if np.isfinite(x.sigma) else None for n, x in intervals.items()},
            rms={sensor: rms.tolist() for sensor, rms in self.rms.items()},
        )  # fmt: skip

    def simulated(
        self, recordings: Sequence[Recording], *, starts: bool | None = None
    ) -> Traces:
        """Other recordings beside what is simulated from their own first samples, or with `starts`
        from the first states that suit them best (`free_run`). None: as the fit did."""
        starts = self.error.own > 0 if starts is None else starts
        columns = {sensor: self.setup.columns(sensor) for sensor in self.rms}
        sigma = {sensor: columns[sensor].noise(rms) for sensor, rms in self.rms.items()}
        noise = {sensor: np.where(rms > 0, rms, 1.0) for sensor, rms in sigma.items()}
        return free_run(self.setup, recordings, grid=self.grid, starts=starts, noise=noise)

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
    def unmoved(self) -> tuple[str, ...]:
        """Sensors whose readings no unknown moves: they say nothing of what is sought."""
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
        error of a sensor (None: `judged`).

        Raises:
            InputError: a recording that was fitted.
            UnknownName: a sensor that was not fitted.
        """
        sensor = self.judged if sensor is None else sensor
        if sensor not in self.rms:
            raise UnknownName("sensor", sensor, self.rms)
        seen, unseen = self.traces, self.simulated(recordings, starts=starts)
        return held_out(
            {name: sensors[sensor].residual for name, sensors in seen.items()},
            {name: sensors[sensor].residual for name, sensors in unseen.items()},
            measured={name: sensors[sensor].recorded for name, sensors in unseen.items()},
            unit=self.setup.unit(sensor),
        )
