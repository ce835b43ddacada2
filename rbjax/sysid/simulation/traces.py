"""What was recorded beside what a fit simulates, by recording and sensor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from rbjax.model import Model
from rbjax.sensors.columns import Columns, root_mean_square
from rbjax.sysid.data.recording import JOINT_SENSORS, Recording
from rbjax.sysid.simulation.runs import ordered
from rbjax.sysid.simulation.setup import Setup
from rbjax.sysid.simulation.simulation_error import SimulationError

#: fewer samples say nothing of a motion
FEW = 10


class Trace(NamedTuple):
    """One sensor of one recording.

    Fields: names of the columns (n,); t (T,) in s after the start; recorded (T, n), nan where
    nothing arrived; simulated (T, n); both in SI; turns, where quaternions begin.
    """

    names: tuple[str, ...]
    t: np.ndarray
    recorded: np.ndarray
    simulated: np.ndarray
    turns: tuple[int, ...] = ()

    @property
    def residual(self) -> np.ndarray:
        """Simulated less recorded (T, n); of quaternions twice that, which is in rad."""
        return self.columns.residual(self.recorded, self.simulated)

    @property
    def columns(self) -> Columns:
        """The columns, with the attitudes among them."""
        return Columns(len(self.names), self.turns)

    @property
    def measured(self) -> bool:
        """Whether every column that was recorded has samples enough for a motion, not only its
        start."""
        count = (~np.isnan(self.recorded)).sum(0)
        return bool(count.any() and count[count > 0].min() >= FEW)


Traces = Mapping[str, Mapping[str, Trace]]  # by recording, by sensor


def traces(
    setup: Setup, of: SimulationError, x: np.ndarray, recordings: Sequence[Recording]
) -> dict[str, dict[str, Trace]]:
    """The traces of the runs of `of`, which are those of the recordings, at x."""
    data, read = jax.tree.map(np.asarray, (of.runs, of.readings(x)))
    found: dict[str, dict[str, Trace]] = {}
    for k, run in enumerate(recordings):
        channels = ordered(setup.model, run).channels
        found[run.name] = {}
        for sensor in data.values:
            there = data.weights[sensor][k] > 0
            T = int(np.flatnonzero(there.any(1))[-1]) + 1  # what follows fills the batch up
            values = data.values[sensor][k]
            recorded = np.where(there, values, np.nan)[:T]
            simulated = read[sensor][k][:T]
            columns, names = setup.columns(sensor), channels[sensor].names
            found[run.name][sensor] = Trace(
                _names(setup.model, names) if sensor in JOINT_SENSORS else names,
                data.times[sensor][k][:T], columns.aligned(recorded, simulated),
                simulated, columns.turns,
            )  # fmt: skip
    return found


def rms_of(found: Traces) -> dict[str, np.ndarray]:
    """By sensor, the residual's root mean square over all recordings, one number a column."""
    sensors: Iterable[str] = next(iter(found.values()))
    return {sensor: root_mean_square(together(found, sensor)) for sensor in sensors}


def together(found: Traces, sensor: str) -> np.ndarray:
    """A sensor's residuals in all recordings (samples, n)."""
    return np.concatenate([sensors[sensor].residual for sensors in found.values()])


def _names(model: Model, names: tuple[str, ...]) -> tuple[str, ...]:
    """Columns that have only numbers are those of the joints, where each has one."""
    plain = names == tuple(map(str, range(len(names))))
    return tuple(model.joint_names) if plain and len(model.joint_names) == len(names) else names
