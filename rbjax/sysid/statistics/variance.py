"""The share of the variance of recordings that a simulation explains, and whether they vary."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

#: a column whose range is below this share of its size is constant: the rest is rounding
CONSTANT = 1e-9


def varies(recorded: np.ndarray) -> np.ndarray:
    """(n,) whether each column of (T, n) varies, without the samples that are nan."""
    found = np.zeros(recorded.shape[1], bool)
    some = ~np.isnan(recorded).all(0)
    y = recorded[:, some]
    size = np.nanmax(np.abs(y), 0, initial=0.0)
    found[some] = np.nanmax(y, 0, initial=-np.inf) - np.nanmin(y, 0, initial=np.inf) > (
        CONSTANT * size
    )
    return found


def explained(recorded: Iterable[np.ndarray], residuals: Iterable[np.ndarray]) -> float:
    """1 - sum r^2 / sum (y - mean)^2 of recordings (T, n) each, with the mean of each column in
    each recording. nan if every column is constant: there is no variance that a model could
    explain."""
    left = there = 0.0
    for y, r in zip(recorded, residuals, strict=True):
        left += float(np.nansum(r**2))
        moving = varies(y)
        there += float(np.nansum((y[:, moving] - np.nanmean(y[:, moving], 0)) ** 2))
    return 1 - left / there if there > 0 else np.nan
