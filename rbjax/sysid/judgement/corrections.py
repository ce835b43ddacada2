"""Mistakes in recordings, the result of `diagnose`, and their corrections.

The corrected clock is that of the sensors, relative to that of the commands. A recording y with a
clock that runs at 1 / (1 + b) of the right rate has a growing lag relative to a simulated motion s.
Wrong parameters cause a constant lag, gain and offset. Each column is fitted by

    y(t) ~ c + a s((1 + b) t) + d s'((1 + b) t)

for every rate b, to first order in the lag. The estimated rate has the least residual variance. The
motion of the first guess shows the full clock error, but fitted parameters may compensate a part.

Source: Knapp & Carter 1976, IEEE Trans. ASSP 24(4) (delays by likelihood); linear least squares.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from rbjax.display import displayed
from rbjax.sysid.data.recording import HELD, Recording
from rbjax.sysid.simulation.traces import FEW, Trace, Traces

Correction = Callable[[Recording], Recording]
#: (run, sensor, column index, column name) -> mask of the samples to drop, from the start time on
Lost = dict[tuple[str, str, int, str], np.ndarray]


@displayed
@dataclass(frozen=True)
class Cause:
    """One mistake in the recordings.

    Fields:
        kind: "sign", "swap", "clock", "outliers" or "dead".
        channels, columns: names of the affected channels and columns.
        before, after: error without and with the correction.
        sentence: description for users.
    """

    kind: str
    channels: tuple[str, ...]
    columns: tuple[str, ...]
    before: float
    after: float
    sentence: str

    def __str__(self) -> str:
        return self.sentence


@displayed
@dataclass(frozen=True)
class Diagnosis:
    """The mistakes in the recordings of a fit.

    Fields:
        causes: the mistakes, sorted by the reduction of the error.
        recordings: the recordings with all corrections.
    """

    causes: tuple[Cause, ...]
    recordings: tuple[Recording, ...]

    def summary(self) -> str:
        """Return the causes as text, one sentence a line."""
        none = "no flipped sign, swapped joint, wrong clock, outlier or dead sensor explains the "
        return "\n".join(map(str, self.causes)) or none + "error"


def drop_samples(runs: Sequence[Recording], lost: Lost) -> list[Recording]:
    """Mark the samples of a mask as missing in recordings."""
    out = []
    for run in runs:
        channels = dict(run.channels)
        for (name, sensor, j, _), rows in lost.items():
            if name != run.name:
                continue
            channel = channels[sensor]
            first = int(np.searchsorted(channel.t, run.start - 1e-9))
            drop = np.zeros(channel.values.shape, bool)
            drop[first : first + len(rows), j] = rows
            channels[sensor] = channel.drop(drop)
        out.append(dataclasses.replace(run, channels=channels))
    return out


def flip(group: tuple[str, ...], i: int) -> Correction:
    """Return the correction that changes the sign of column i of the given channels."""
    return _change_columns(group, (i,), lambda x: -x)


def swap(group: tuple[str, ...], i: int, j: int) -> Correction:
    """Return the correction that swaps columns i and j of the given channels."""
    return _change_columns(group, (i, j), lambda x: x[:, ::-1])


def _change_columns(
    group: tuple[str, ...], columns: tuple[int, ...], change: Callable[[np.ndarray], np.ndarray]
) -> Correction:
    def correct(run: Recording) -> Recording:
        channels = dict(run.channels)
        for sensor in group:
            values = channels[sensor].values.copy()
            values[:, columns] = change(values[:, columns])
            channels[sensor] = channels[sensor].replace(channels[sensor].t, values)
        return dataclasses.replace(run, channels=channels)

    return correct


def stretch(rate: float) -> Correction:
    """Return the correction that multiplies the times of the sensors by 1 + rate.

    The clock of the commands does not change.
    """

    def correct(run: Recording) -> Recording:
        channels = dict(run.channels)
        for sensor, c in channels.items():
            if sensor != HELD:
                channels[sensor] = c.replace(c.t[0] + (c.t - c.t[0]) * (1 + rate), c.values)
        return dataclasses.replace(run, channels=channels)

    return correct


#: candidate clock rates b
RATES = np.linspace(-0.05, 0.05, 201)
#: largest accepted ratio of the residual variances with and without a clock rate
LEFT = 0.5


def estimate_clock_rate(seen: Traces) -> float:
    """Estimate the rate b of the sensors' clock: sensor times are multiplied by 1 + b.

    Return the candidate of `RATES` with the least residual variance, or 0 if no rate halves it.
    """
    left = np.zeros(len(RATES))
    for sensors in seen.values():
        for trace in sensors.values():
            if trace.measured:
                left += _residual_variance(trace)
    k = int(np.argmin(left))
    return float(RATES[k]) if left[k] <= LEFT * left[len(RATES) // 2] else 0.0


def _residual_variance(trace: Trace) -> np.ndarray:
    """Compute the relative residual variance at each clock rate, summed over the columns."""
    left = np.zeros(len(RATES))
    rise = np.gradient(trace.simulated, trace.t, axis=0)
    for y, s, ds in zip(trace.recorded.T, trace.simulated.T, rise.T, strict=True):
        known = ~np.isnan(y)
        if known.sum() < FEW or np.ptp(y[known]) == 0:
            continue
        for k, b in enumerate(RATES):
            t = trace.t[known] * (1 + b)
            inside = t <= trace.t[-1]
            t, seen = t[inside], y[known][inside]
            rows = [np.ones(len(t)), np.interp(t, trace.t, s), np.interp(t, trace.t, ds)]
            A = np.stack(rows, 1)
            off = seen - A @ np.linalg.lstsq(A, seen, rcond=None)[0]
            left[k] += (off @ off) / max(len(t) * seen.var(), 1e-300)
    return left
