"""The covariance of a regression of torques, by `fit_statistics` from its residuals."""

from __future__ import annotations

import dataclasses
import itertools
from typing import TYPE_CHECKING

import numpy as np
import scipy.stats

from rbjax.sysid.statistics.fit_statistics import FEW, Column, FitStatistics, Rows, fit_statistics
from rbjax.sysid.torque.stacking import Equations

if TYPE_CHECKING:
    from rbjax.sysid.torque.regression import Regression

Array = np.ndarray
#: Noise below this times a torque's size is rounding.
ROUNDING = 1e-13
#: If residuals are below this times the given noise, they are no estimate of the noise.
SMALL = 1e-6


def with_statistics(
    eq: Equations, found: Regression, sd: Array, psi: Array | None = None,
    slope: Array | None = None,
) -> Regression:  # fmt: skip
    """The regression with the covariance of `fit_statistics`. Given noise is used unless the
    residuals contradict it with at least `FEW` degrees of freedom."""
    psi = found.residual / sd if psi is None else psi
    slope = np.ones_like(psi) if slope is None else slope
    free = int(eq.counted.sum()) - found.beta.size
    if negligible(eq, found.residual) or (eq.noise is not None and free < FEW):
        return found
    said = statistics_of(eq, psi, slope, sd)
    agrees = eq.noise is not None and said.white and _agrees(eq, found.residual)
    if agrees and np.isinf(found.dof):
        return found
    dof = float(free) if said.white else said.estimates.dof
    return dataclasses.replace(
        found, covariance=said.estimates.covariance, dof=dof, white=said.white
    )


def _agrees(eq: Equations, residual: Array) -> bool:
    """Whether the size of the residuals agrees with the given noise, by a two-sided chi-square test
    with 1 % on each side."""
    assert eq.noise is not None
    free = int(eq.counted.sum()) - eq.combinations.rank
    squares = float(((residual / eq.noise) ** 2).sum())
    low, high = scipy.stats.chi2.ppf([0.01, 0.99], free)
    return bool(low <= squares <= high)


def negligible(eq: Equations, residual: Array) -> bool:
    """Whether the residuals are rounding, or negligible compared with the given noise."""
    size = np.abs(residual[eq.counted]).max()
    if eq.noise is not None and size < SMALL * eq.noise.min():
        return True
    return bool(size <= 100 * ROUNDING * np.abs(eq.tau).max())


def statistics_of(eq: Equations, psi: Array, slope: Array, sd: Array) -> FitStatistics:
    """The statistics of the residuals psi (N, k), in standard deviations."""
    X = eq.X / sd[..., None]
    ends = np.cumsum([0, *eq.lengths])
    columns = [
        Column(
            f"channel {c}",
            [
                _rows(eq.counted[a:b, c], X[a:b, c], psi[a:b, c], slope[a:b, c])
                for a, b in itertools.pairwise(ends)
            ],
            eq.noise is not None,
        )
        for c in range(eq.tau.shape[1])
    ]
    names = [eq.combinations.names[j] for j in eq.combinations.kept]
    return fit_statistics(names, np.zeros(len(names)), columns)


def _rows(counted: Array, X: Array, psi: Array, slope: Array) -> Rows:
    """The rows of a channel in a recording, of the samples that count."""
    which = np.arange(X.shape[-1])
    return Rows(X[counted], psi[counted], slope[counted], np.flatnonzero(counted), which)
