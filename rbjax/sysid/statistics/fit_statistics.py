"""Covariance of estimates, for every estimator with residuals and a Jacobian.

A fit minimises the sum over rows of rho(r). psi = rho' / 2 is r for squares, and clipped r for
"huber". With rows of several columns c (one axis of a sensor), each weighted by 1 / sigma_c,

    H = sum_c a_c J_c^T J_c,        a_c = mean psi'_c,        cov = H^-1 M H^-1
    M = sum_c s_c^2 J_c^T J_c,      s_c^2 = sum psi_c^2 / (m_c - h_c)       if psi is white
    M = sum_|l|<=L (1 - |l| / (L + 1)) sum_t g_t g_(t+l)^T    otherwise
g_t are the scores of the innovations of psi (`_scores`). m_c is the number of rows of a column (an
attitude has three columns). h_c is the number of estimates that the column determines (the trace of
the hat matrix). The intervals depend on the residuals, and remain valid if the stated noise is
wrong.

Source: Huber, *Robust Statistics*, 6.3 and 7.6; White, Econometrica 48(4), 1980; Newey & West,
Econometrica 55(3), 1987; Andrews, Econometrica 59(3), 1991; Andrews & Monahan, Econometrica 60(4),
1992 (prewhitening of the scores); Kendall, Biometrika 41, 1954 (bias of the correlation).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import signal

from rbjax.sysid.statistics.intervals import Estimates, decomposed, estimates, tolerance_for
from rbjax.sysid.statistics.residual_tests import ALPHA, long_run_covariance, whiteness

#: with fewer degrees of freedom, the noise of a column is not estimated
FEW = 5.0
#: with fewer samples, whiteness is not tested
SHORT = 20
#: largest assumed correlation of successive samples
STEADY = 0.985


class FitRows(NamedTuple):
    """The rows of the least-squares problem from one column in one run.

    Fields:
        J: (m, d) derivatives along d directions.
        psi: (m,) residual, clipped for "huber".
        inside: (m,) psi', which is 1, or 0 if clipped.
        place: (m,) index of the sample in the run.
        which: (k,) indices of x.
        basis: (d, k) matrix. The derivatives by the entries `which` of x are J basis. None: the
            identity.
    """

    J: np.ndarray
    psi: np.ndarray
    inside: np.ndarray
    place: np.ndarray
    which: np.ndarray
    basis: np.ndarray | None = None

    def times(self, matrix: np.ndarray) -> np.ndarray:
        """Multiply the derivatives by x, (m, n), with a matrix (n, r)."""
        own = matrix[self.which]
        return self.J @ (own if self.basis is None else self.basis @ own)


class FitColumn(NamedTuple):
    """All rows of one column. `stated` is True if its noise is stated."""

    name: str
    runs: Sequence[FitRows]
    stated: bool


@dataclass(frozen=True, eq=False)
class FitStatistics:
    """Statistics of a fit from its residuals and its Jacobian.

    Fields:
        estimates: values, covariance and intervals.
        scale: column -> standard deviation of the weighted residual.
        rows: number of residuals.
        coloured: names of the columns with residuals that are not white.
        effective: share of samples that are independent.
    """

    estimates: Estimates
    scale: dict[str, float]
    rows: int
    coloured: tuple[str, ...]
    effective: float

    @property
    def white(self) -> bool:
        """Whether the residuals of all columns are white."""
        return not self.coloured


def fit_statistics(
    names: Sequence[str], x: np.ndarray, columns: Sequence[FitColumn],
    bounds: Mapping[str, tuple[float, float]] | None = None, factor: np.ndarray | None = None,
) -> FitStatistics:  # fmt: skip
    """Compute covariance and intervals of the estimates x (n,).

    factor: (.., n) with factor^T factor = sum J^T J, if it is known. It saves a QR factorisation
    unless residuals are clipped.
    """
    shares = [_mean([r.inside for r in column.runs]) for column in columns]
    if factor is None or any(a != 1 for a in shares):
        factor = _slopes(columns, shares, len(x))
    R = factor
    flat = estimates(names, x, R, 1.0, bounds=bounds)
    lengths, s, V, _ = decomposed(R, tolerance_for(R))
    half = V / s / lengths[:, None]  # half half^T = H^-1
    scaled = [[rows.times(half) for rows in column.runs] for column in columns]
    rank = half.shape[1]
    counts = np.array([sum(len(rows.psi) for rows in column.runs) for column in columns])
    squares = np.array([sum(float(rows.psi @ rows.psi) for rows in c.runs) for c in columns])
    hats = np.array([
        a * sum(float((G**2).sum()) for G in each) for a, each in zip(shares, scaled, strict=True)
    ])  # fmt: skip
    dof = np.maximum(counts - hats, 0.0)
    pooled = squares.sum() / max(dof.sum(), 1.0)
    stated = np.array([column.stated for column in columns])
    alone = np.where(dof > 0, squares / np.where(dof > 0, dof, 1.0), 0.0)
    variance = np.where(dof >= FEW, alone, np.where(stated, 1.0, pooled))
    coloured, effective = _test_whiteness(columns)
    if coloured:
        rho = _correlations(columns, hats, counts)
        meat = long_run_covariance(_scores(columns, scaled, rho))
        largest = max(r for c, r in zip(columns, rho, strict=True) if c.name in coloured)
        effective = min(effective, (1 - largest) / (1 + largest))
        # each estimate uses up one independent sample
        free = max(effective * dof.sum() - rank, 2.0)
        meat = meat * (counts.sum() / max(counts.sum() - rank, 1))
    else:
        meat, free = np.zeros((rank, rank)), max(float(dof.sum()), 1.0)
        for s2, each in zip(variance, scaled, strict=True):
            for G in each:
                meat += s2 * G.T @ G
    found = Estimates(
        flat.names, flat.values, half @ meat @ half.T, flat.free, free, flat.bounds, flat.lengths
    )
    scale = {c.name: float(np.sqrt(s2)) for c, s2 in zip(columns, variance, strict=True)}
    return FitStatistics(found, scale, int(counts.sum()), coloured, effective)


def _slopes(columns: Sequence[FitColumn], shares: Sequence[float], n: int) -> np.ndarray:
    """Compute the triangular R with R^T R = sum_c a_c J_c^T J_c over columns c.

    shares: a_c, the mean derivative of psi in each column.
    n: number of entries of x.
    """
    parts = []
    for k in range(len(columns[0].runs)):
        by_basis: dict[int, list[tuple[float, FitRows]]] = {}
        for a, column in zip(shares, columns, strict=True):
            by_basis.setdefault(id(column.runs[k].basis), []).append((a, column.runs[k]))
        for run in by_basis.values():
            basis, which = run[0][1].basis, run[0][1].which
            rows = np.concatenate([np.sqrt(a) * r.J for a, r in run])
            R = np.linalg.qr(rows, mode="r") if len(rows) > rows.shape[1] else rows
            wide = np.zeros((len(R), n))
            wide[:, which] = R if basis is None else R @ basis
            parts.append(wide)
    whole = np.concatenate(parts)
    return np.asarray(np.linalg.qr(whole, mode="r")) if len(parts) > 1 else whole


def _mean(parts: Sequence[np.ndarray]) -> float:
    """Compute the mean of all entries, at least 1e-3, because a mean of 0 makes the Hessian
    singular."""
    count = sum(len(x) for x in parts)
    return max(sum(float(x.sum()) for x in parts) / max(count, 1), 1e-3)


def _test_whiteness(columns: Sequence[FitColumn]) -> tuple[tuple[str, ...], float]:
    """Test the residuals for correlation in time.

    Return the correlated columns, and the smallest share of independent samples among them.
    """
    tests = []
    for column in columns:
        for rows in column.runs:
            if len(rows.psi) >= SHORT and np.ptp(rows.psi) > 0:
                tests.append((column.name, whiteness(rows.psi), len(rows.psi)))
    found = [(name, w, m) for name, w, m in tests if w.p_value * len(tests) < ALPHA]
    names = tuple(dict.fromkeys(name for name, _, _ in found))
    return names, min((w.effective_samples / m for _, w, m in found), default=1.0)


def _correlations(columns: Sequence[FitColumn], hats: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Estimate the correlation of successive noise samples, by column.

    The correlation of the residuals is smaller by at most (h + (h + 2) rho) / n, since the h
    estimates that a column determines follow slow noise. The estimate corrects this bias.
    """
    found = np.zeros(len(columns))
    for c, column in enumerate(columns):
        power = sum(float(rows.psi @ rows.psi) for rows in column.runs)
        if power > 0:
            next_ = sum(float(rows.psi[1:] @ rows.psi[:-1]) for rows in column.runs)
            found[c] = next_ / power
    found = found + (hats + (hats + 2) * found) / np.maximum(counts, 1)
    return np.clip(found, -STEADY, STEADY)


def _scores(
    columns: Sequence[FitColumn], scaled: Sequence[Sequence[np.ndarray]], rho: np.ndarray
) -> list[np.ndarray]:
    """Compute the scores (samples, rank) of each run. Their sum over the samples is J^T psi.

    psi is modelled as a first-order process with innovations e. The score v_s e_s of a sample is
    the effect of its innovation on all later psi: sum_t G_t psi_t = sum_s v_s e_s,  v_s =
    sum_(t>=s) rho^(t-s) G_t.
    """
    found = []
    for k in range(len(columns[0].runs)):
        length = max((int(c.runs[k].place.max(initial=-1)) for c in columns), default=-1) + 1
        g = np.zeros((max(length, 1), scaled[0][k].shape[1]))
        for column, each, r in zip(columns, scaled, rho, strict=True):
            rows, G = column.runs[k], each[k]
            if not len(rows.psi):
                continue
            e, first = rows.psi.copy(), np.sqrt(1 - r**2)
            e[1:] -= r * rows.psi[:-1]
            v = signal.lfilter([1.0], [1.0, -r], G[::-1], axis=0)[::-1].copy()
            e[0], v[0] = e[0] * first, v[0] / first
            v *= e[:, None]
            if (np.diff(rows.place) > 0).all():  # no sample twice
                g[rows.place] += v
            else:
                np.add.at(g, rows.place, v)
        found.append(g)
    return found
