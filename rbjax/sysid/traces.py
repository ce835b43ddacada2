"""What was recorded beside what a fit simulates, by recording and sensor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from rbjax.model import Model
from rbjax.sysid.recording import Recording
from rbjax.sysid.runs import ordered
from rbjax.sysid.simulation_error import SimulationError

#: fewer samples say nothing of a motion
FEW = 10


class Trace(NamedTuple):
    """One sensor of one recording.

    Fields: names of the columns (n,); t (T,) in s after the start; recorded (T, n), nan where
    nothing arrived; simulated (T, n); both in SI.
    """

    names: tuple[str, ...]
    t: np.ndarray
    recorded: np.ndarray
    simulated: np.ndarray

    @property
    def residual(self) -> np.ndarray:
        """Simulated less recorded (T, n)."""
        return self.simulated - self.recorded

    @property
    def measured(self) -> bool:
        """Whether every column has samples enough for a motion, not only its start."""
        return bool((~np.isnan(self.recorded)).sum(0).min() >= FEW)


Traces = Mapping[str, Mapping[str, Trace]]  # by recording, by sensor


def traces(
    model: Model, of: SimulationError, x: np.ndarray, recordings: Sequence[Recording]
) -> dict[str, dict[str, Trace]]:
    """The traces of the runs of `of`, which are those of the recordings, at x."""
    data, read = of.runs, of.readings(x)
    found: dict[str, dict[str, Trace]] = {}
    for k, run in enumerate(recordings):
        channels = ordered(model, run).channels
        found[run.name] = {}
        for sensor in data.values:
            there = np.asarray(data.weights[sensor][k]) > 0
            T = int(np.flatnonzero(there.any(1))[-1]) + 1  # what follows fills the batch up
            values = np.asarray(data.values[sensor][k])
            found[run.name][sensor] = Trace(
                _names(model, channels[sensor].names), np.asarray(data.times[sensor][k])[:T],
                np.where(there, values, np.nan)[:T], np.asarray(read[sensor][k])[:T],
            )  # fmt: skip
    return found


def rms_of(found: Traces) -> dict[str, np.ndarray]:
    """By sensor, the residual's root mean square over all recordings, one number a column."""
    sensors: Iterable[str] = next(iter(found.values()))
    return {
        sensor: np.sqrt(np.nanmean(together(found, sensor) ** 2, axis=0)) for sensor in sensors
    }


def together(found: Traces, sensor: str) -> np.ndarray:
    """A sensor's residuals in all recordings (samples, n)."""
    return np.concatenate([sensors[sensor].residual for sensors in found.values()])


def _names(model: Model, names: tuple[str, ...]) -> tuple[str, ...]:
    """Columns that have only numbers are those of the joints, where each has one."""
    plain = names == tuple(map(str, range(len(names))))
    return tuple(model.joint_names) if plain and len(model.joint_names) == len(names) else names
