"""Residuals and slopes of a simulation error, by column, as input of `fit_statistics`."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import jax
import numpy as np

from rbjax.sysid.simulation.simulation_error import HUBER, SimulationError
from rbjax.sysid.statistics.fit_statistics import Column, Rows


def columns_of(of: SimulationError, x: np.ndarray, stated: Collection[str]) -> list[Column]:
    """The columns of the residual at x. stated: the sensors whose noise is stated."""
    r, J = of.slopes(x)
    n, l = of.shared, of.own
    which = [np.r_[0:n, n + k * l : n + (k + 1) * l] for k in range(of.count)]
    clocks = {s: np.asarray(t) for s, t in of.runs.times.items()}
    step = min(_step(t) for t in clocks.values())
    found, at = [], 0
    for sensor in sorted(of.runs.values):
        columns = of.setup.columns(sensor)
        weights: Any = np.asarray(of.runs.weights[sensor])
        there = np.asarray(columns.weights(weights)) > 0
        T, d = there.shape[1:]
        own = slice(at, at + T * d)
        at += T * d
        place = np.rint(clocks[sensor] / step).astype(int)
        for c in range(d):
            runs = []
            for k in range(of.count):
                rows = there[k, :, c]
                off = r[k, own].reshape(T, d)[rows, c]
                slopes = J[k, own].reshape(T, d, -1)[rows, c]
                psi, inside = off, np.ones(len(off), bool)
                if of.loss == "huber":  # beyond its knee the residual is sign sqrt(2 rho)
                    inside = np.abs(off) < HUBER
                    psi = np.where(inside, off, HUBER * np.sign(off))
                    slopes = slopes * np.where(inside, 1.0, np.abs(off) / HUBER)[:, None]
                runs.append(Rows(slopes, psi, inside, place[k][rows], which[k]))
            if any(len(rows.psi) for rows in runs):
                found.append(Column(f"{sensor}[{c}]", runs, sensor in stated))
    return found


def _step(times: np.ndarray) -> float:
    """The median step of clocks (runs, T), which are padded with their last time."""
    steps = np.diff(times, axis=-1)
    return float(np.median(steps[steps > 0])) if (steps > 0).any() else np.inf


def samples_of(of: SimulationError) -> int:
    """The number of residuals; an attitude has three."""
    weights = jax.tree.map(np.asarray, of.runs.weights)
    return sum(int((of.setup.columns(s).weights(w) > 0).sum()) for s, w in weights.items())
