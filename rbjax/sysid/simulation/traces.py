"""Traces: recorded and simulated values, by recording and sensor."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from rbjax.display import displayed
from rbjax.model import Model
from rbjax.sensors.columns import Columns, root_mean_square
from rbjax.sysid.data.recording import JOINT_SENSORS, Recording
from rbjax.sysid.simulation.runs import order_columns
from rbjax.sysid.simulation.setup import Setup
from rbjax.sysid.simulation.simulation_error import SimulationError

#: least number of samples of a measured motion
FEW = 10


@displayed
class Trace(NamedTuple):
    """Recorded and simulated values of one sensor in one recording.

    Fields:
        names: (n,) names of the columns.
        t: (T,) times in s after the start.
        recorded: (T, n) values in SI, nan for missing samples.
        simulated: (T, n) values in SI.
        turns: first column of each quaternion.
    """

    names: tuple[str, ...]
    t: np.ndarray
    recorded: np.ndarray
    simulated: np.ndarray
    turns: tuple[int, ...] = ()

    @property
    def residual(self) -> np.ndarray:
        """The simulated minus recorded values (T, n), multiplied by 2 for quaternions, in rad."""
        return self.columns.residual(self.recorded, self.simulated)

    @property
    def columns(self) -> Columns:
        """The `Columns` of the sensor, with its quaternions."""
        return Columns(len(self.names), self.turns)

    @property
    def measured(self) -> bool:
        """Whether each column with samples has at least `FEW` of them."""
        count = (~np.isnan(self.recorded)).sum(0)
        return bool(count.any() and count[count > 0].min() >= FEW)


Traces = Mapping[str, Mapping[str, Trace]]  # recording -> sensor -> trace


def make_traces(
    setup: Setup, of: SimulationError, x: np.ndarray, recordings: Sequence[Recording]
) -> dict[str, dict[str, Trace]]:
    """Simulate at x, and return the recorded and simulated values of recordings.

    `recordings` are the runs of the simulation error `of`.
    """
    data, read = jax.tree.map(np.asarray, (of.runs, of.readings(x)))
    found: dict[str, dict[str, Trace]] = {}
    for k, run in enumerate(recordings):
        channels = order_columns(setup.model, run).channels
        found[run.name] = {}
        for sensor in data.values:
            there = data.weights[sensor][k] > 0
            T = int(np.flatnonzero(there.any(1))[-1]) + 1  # later samples are padding
            values = data.values[sensor][k]
            recorded = np.where(there, values, np.nan)[:T]
            simulated = read[sensor][k][:T]
            columns, names = setup.columns(sensor), channels[sensor].names
            found[run.name][sensor] = Trace(
                _joint_names(setup.model, names) if sensor in JOINT_SENSORS else names,
                data.times[sensor][k][:T], columns.aligned(recorded, simulated),
                simulated, columns.turns,
            )  # fmt: skip
    return found


def rms_of(found: Traces) -> dict[str, np.ndarray]:
    """Compute the root mean square of the residual (n,) over all recordings, by sensor."""
    sensors: Iterable[str] = next(iter(found.values()))
    return {sensor: root_mean_square(residuals_of(found, sensor)) for sensor in sensors}


def residuals_of(found: Traces, sensor: str) -> np.ndarray:
    """Concatenate the residuals (samples, n) of a sensor in all recordings."""
    return np.concatenate([sensors[sensor].residual for sensors in found.values()])


def _joint_names(model: Model, names: tuple[str, ...]) -> tuple[str, ...]:
    """Replace numbered columns by joint names, if each joint has one column."""
    plain = names == tuple(map(str, range(len(names))))
    return tuple(model.joint_names) if plain and len(model.joint_names) == len(names) else names
