"""Mends of recordings: what undoes a mistake of the log, on all channels that it concerns."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np

from rbjax.sysid.data.recording import HELD, Channel, Recording

Mend = Callable[[Recording], Recording]
#: run, sensor, place and name of the column -> which samples, from the start on
Lost = dict[tuple[str, str, int, str], np.ndarray]


def without(runs: Sequence[Recording], lost: Lost) -> list[Recording]:
    """The recordings without these samples."""
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


def flip(group: tuple[str, ...], i: int) -> Mend:
    """Another sign for a column of these channels."""

    def mended(values: np.ndarray) -> np.ndarray:
        values[:, i] *= -1
        return values

    return _on_values(group, mended)


def swap(group: tuple[str, ...], i: int, j: int) -> Mend:
    """Two columns of these channels, each in the place of the other."""

    def mended(values: np.ndarray) -> np.ndarray:
        values[:, [i, j]] = values[:, [j, i]]
        return values

    return _on_values(group, mended)


def _on_values(group: tuple[str, ...], mended: Callable[[np.ndarray], np.ndarray]) -> Mend:
    def mend(run: Recording) -> Recording:
        channels = dict(run.channels)
        for sensor in group:
            c = channels[sensor]
            values = mended(c.values.copy())
            channels[sensor] = Channel(c.t, values, c.names, noise=c.noise, dropped="nan")
        return dataclasses.replace(run, channels=channels)

    return mend


def stretch(rate: float) -> Mend:
    """A clock of the sensors that runs slower by this rate; that of the commands stays."""

    def mend(run: Recording) -> Recording:
        channels = dict(run.channels)
        for sensor, c in channels.items():
            if sensor != HELD:
                t = c.t[0] + (c.t - c.t[0]) * (1 + rate)
                channels[sensor] = Channel(t, c.values, c.names, noise=c.noise, dropped="nan")
        return dataclasses.replace(run, channels=channels)

    return mend
