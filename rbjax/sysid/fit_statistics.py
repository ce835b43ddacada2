"""The covariance of fitted numbers, the same for every estimator with residuals and slopes.

A fit minimises the sum over rows of rho(r); psi = rho' / 2 is r for squares, and clipped for
"huber". With rows of several columns c (a sensor's axis), each weighted by 1 / sigma_c,

    H = sum_c a_c J_c^T J_c,        a_c = mean psi'_c,        cov = H^-1 M H^-1
    M = sum_c s_c^2 J_c^T J_c,      s_c^2 = sum psi_c^2 / (m_c - h_c)       if psi is white
    M = sum_|l|<=L (1 - |l| / (L + 1)) sum_t g_t g_(t+l)^T,   g_t = sum_c J_c^T psi_c   if not
h_c is the number of fitted numbers that the column determines (the trace of the hat matrix). So
intervals follow the residuals, whether the noise is stated, estimated or wrong. m_c is the number
of rows of the residual; an attitude has three.

Source: Huber, *Robust Statistics*, 6.3 and 7.6; White, Econometrica 48(4), 1980; Newey & West,
Econometrica 55(3), 1987; Andrews, Econometrica 59(3), 1991; Andrews & Monahan, Econometrica 60(4),
1992 (prewhitening).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rbjax.sysid.statistics import Estimates, decomposed, estimates, tolerance_for
from rbjax.sysid.whiteness import ALPHA, meat_of, whiteness

#: with fewer degrees of freedom a column's noise is not estimated
FEW = 5.0
#: with fewer samples whiteness is not tested
SHORT = 20
#: the largest correlation of neighbours that prewhitening removes
STEADY = 0.97


class Rows(NamedTuple):
    """Rows of one column in one run.

    J: (m, k), the slopes by the numbers `which`.
    psi: (m,), the residual, clipped for "huber".
    inside: (m,), psi': 1, or 0 if clipped.
    place: (m,), the index of the sample in the run.
    which: (k,), indices of x.
    """

    J: np.ndarray
    psi: np.ndarray
    inside: np.ndarray
    place: np.ndarray
    which: np.ndarray


class Column(NamedTuple):
    """All rows of one column: its name; a `Rows` for each run; whether its noise is stated."""

    name: str
    runs: Sequence[Rows]
    stated: bool


@dataclass(frozen=True, eq=False)
class FitStatistics:
    """Statistics of a fit from its residuals and slopes.

    Fields:
        estimates: values, covariance and intervals.
        scale: by column, the standard deviation of the residual over the one that weighted it.
        rows: the number of residuals.
        white: whether the residuals of all columns are white.
        coloured: the columns whose residuals are not white.
        effective: the share of samples that are independent of the others.
    """

    estimates: Estimates
    scale: dict[str, float]
    rows: int
    white: bool
    coloured: tuple[str, ...]
    effective: float


def fit_statistics(
    names: Sequence[str], x: np.ndarray, columns: Sequence[Column],
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> FitStatistics:  # fmt: skip
    """Covariance and intervals of the fitted numbers x (n,)."""
    shares = [_mean([r.inside for r in column.runs]) for column in columns]
    R = _slopes(columns, shares, len(x))
    flat = estimates(names, x, R, 1.0, bounds=bounds)
    lengths, s, V, _ = decomposed(R, tolerance_for(R))
    half = V / s / lengths[:, None]  # half half^T = H^-1
    turned = [[rows.J @ half[rows.which] for rows in column.runs] for column in columns]
    rank = half.shape[1]
    counts = np.array([sum(len(rows.psi) for rows in column.runs) for column in columns])
    squares = np.array([sum(float(rows.psi @ rows.psi) for rows in c.runs) for c in columns])
    hats = np.array([
        a * sum(float((G**2).sum()) for G in each) for a, each in zip(shares, turned, strict=True)
    ])  # fmt: skip
    dof = np.maximum(counts - hats, 0.0)
    pooled = squares.sum() / max(dof.sum(), 1.0)
    stated = np.array([column.stated for column in columns])
    alone = np.where(dof > 0, squares / np.where(dof > 0, dof, 1.0), 0.0)
    variance = np.where(dof >= FEW, alone, np.where(stated, 1.0, pooled))
    coloured, effective = _colours(columns)
    if coloured:
        meat = _long_run(_scores(columns, turned))
        free = max(effective * dof.sum(), 1.0)
        meat = meat * (counts.sum() / max(counts.sum() - rank, 1))
    else:
        meat, free = np.zeros((rank, rank)), max(float(dof.sum()), 1.0)
        for s2, each in zip(variance, turned, strict=True):
            for G in each:
                meat += s2 * G.T @ G
    said = Estimates(
        flat.names, flat.values, half @ meat @ half.T, flat.free, free, flat.bounds, flat.lengths
    )
    scale = {c.name: float(np.sqrt(s2)) for c, s2 in zip(columns, variance, strict=True)}
    return FitStatistics(said, scale, int(counts.sum()), not coloured, coloured, effective)


def _slopes(columns: Sequence[Column], shares: Sequence[float], n: int) -> np.ndarray:
    """A triangular R (n, n) with R^T R = H."""
    by_run = [[column.runs[k] for column in columns] for k in range(len(columns[0].runs))]
    parts = []
    for run in by_run:
        which = run[0].which
        rows = np.concatenate([np.sqrt(a) * r.J for a, r in zip(shares, run, strict=True)])
        R = np.linalg.qr(rows, mode="r") if len(rows) > rows.shape[1] else rows
        wide = np.zeros((len(R), n))
        wide[:, which] = R
        parts.append(wide)
    whole = np.concatenate(parts)
    return np.asarray(np.linalg.qr(whole, mode="r")) if len(parts) > 1 else whole


def _mean(parts: Sequence[np.ndarray]) -> float:
    """The mean of all entries, at least 1e-3: a mean of 0 would leave no slope."""
    count = sum(len(x) for x in parts)
    return max(sum(float(x.sum()) for x in parts) / max(count, 1), 1e-3)


def _colours(columns: Sequence[Column]) -> tuple[tuple[str, ...], float]:
    """The columns whose residuals are correlated in time, and the smallest share of independent
    samples among them."""
    tests = []
    for column in columns:
        for rows in column.runs:
            if len(rows.psi) >= SHORT and np.ptp(rows.psi) > 0:
                tests.append((column.name, whiteness(rows.psi), len(rows.psi)))
    found = [(name, w, m) for name, w, m in tests if w.p_value * len(tests) < ALPHA]
    names = tuple(dict.fromkeys(name for name, _, _ in found))
    return names, min((w.effective_samples / m for _, w, m in found), default=1.0)


def _long_run(scores: Sequence[np.ndarray]) -> np.ndarray:
    """The covariance of the sum of scores. Each is first prewhitened by a process of first order,
    because Bartlett's window would cut off long correlations."""
    before = np.concatenate([g[:-1] for g in scores])
    after = np.concatenate([g[1:] for g in scores])
    power = (before**2).sum(0)
    rho = (after * before).sum(0) / np.where(power > 0, power, 1.0)
    rho = np.clip(rho, -STEADY, STEADY)
    left = [np.concatenate([g[:1] * np.sqrt(1 - rho**2), g[1:] - rho * g[:-1]]) for g in scores]
    return np.asarray(meat_of(left) / np.outer(1 - rho, 1 - rho))


def _scores(
    columns: Sequence[Column], turned: Sequence[Sequence[np.ndarray]]
) -> list[np.ndarray]:
    """By run (samples, rank), the sum of all columns at each sample."""
    found = []
    for k in range(len(columns[0].runs)):
        length = max((int(c.runs[k].place.max(initial=-1)) for c in columns), default=-1) + 1
        g = np.zeros((max(length, 1), turned[0][k].shape[1]))
        for column, each in zip(columns, turned, strict=True):
            rows = column.runs[k]
            np.add.at(g, rows.place, each[k] * rows.psi[:, None])
        found.append(g)
    return found
