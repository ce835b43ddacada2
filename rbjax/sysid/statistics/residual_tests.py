"""Tests of residuals: whiteness, long-run covariance, and explained share of the variance.

Residuals of an incomplete model are correlated in time. Then fewer samples are independent, and the
covariance s^2 (J^T J)^-1 is too small, often by a factor of 10. The sandwich estimate includes the
correlations of the residuals:
    cov = H^-1 (sum_|l|<=L (1 - |l|/(L+1)) sum_k s_k s_(k+l)^T) H^-1,  H = J^T J,  s_k = J_k^T r_k
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import signal, special

from rbjax.arguments import integer, real_array
from rbjax.display import displayed
from rbjax.errors import InputError

ALPHA = 0.01  # significance level


@displayed
@dataclass(frozen=True, eq=False)
class Whiteness:
    """The result of Ljung and Box's test of a residual.

    Fields:
        statistic: Q.
        p_value: probability of a larger Q for white noise.
        correlation: (lags,) autocorrelation at lags 1, 2, ...
        samples: number of samples n.
        effective_samples: number of independent samples with the same variance of the mean.
    """

    statistic: float
    p_value: float
    correlation: np.ndarray
    samples: int
    effective_samples: float

    @property
    def white(self) -> bool:
        """Whether the p value is at least 1 %."""
        return self.p_value >= ALPHA

    def summary(self) -> str:
        """Return the result as one sentence."""
        if self.white:
            return f"the residual is white (Ljung-Box p = {self.p_value:.2g})"
        return (
            f"the residual is not white (Ljung-Box p = {self.p_value:.1g}): {self.samples} samples "
            f"carry the information of {self.effective_samples:.0f} independent ones, so intervals "
            "for white noise are too narrow, and the model lacks an effect"
        )


def whiteness(residual: Any, lags: int | None = None) -> Whiteness:
    """Test whether a residual is white noise, as expected for a complete model.

    Q = n (n + 2) sum_(k<=h) rho_k^2 / (n - k) is chi-squared with h degrees of freedom for white
    noise.

    Args:
        residual: (samples,) residual of one column of one recording, at a constant rate.
        lags: h. None: 20 or a fifth of the samples, whichever is less.

    Returns:
        `Whiteness`.

    Raises:
        InputError: fewer than 10 samples, or values that are not finite or all equal.

    Source: Ljung & Box 1978; Geyer 1992 (effective samples, initial positive sequence).

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.statistics import whiteness
        >>> noise = np.random.default_rng(0).normal(size=500)
        >>> whiteness(noise).white, whiteness(np.cumsum(noise)).white
        (True, False)
    """
    r = real_array("whiteness", "residual", residual, finite=False)
    if r.ndim != 1 or len(r) < 10 or not np.isfinite(r).all() or np.ptp(r) == 0:
        raise InputError(
            f"whiteness: residual has shape {r.shape}, expected (samples,), at least 10 finite "
            "numbers that are not all equal"
        )
    n = len(r)
    h = min(20, n // 5) if lags is None else lags
    integer("whiteness", "lags", h, least=1, most=n - 1)
    r = r - r.mean()
    every = signal.correlate(r, r, method="fft")[n - 1 :]
    every = every / every[0]
    rho = every[1 : h + 1]
    statistic = float(n * (n + 2) * np.sum(rho**2 / (n - np.arange(1, h + 1))))
    p = float(special.chdtrc(h, statistic))
    pairs = every[: 2 * (n // 2)].reshape(-1, 2).sum(1)  # positive for a reversible process
    first = int((pairs <= 0).argmax()) if (pairs <= 0).any() else len(pairs)
    effective = n / max(1.0, 2 * pairs[:first].sum() - 1)
    return Whiteness(statistic, p, rho, n, float(effective))


def long_run_covariance(scores: Sequence[np.ndarray], lag: int | None = None) -> np.ndarray:
    """Estimate the covariance (n, n) of the sum of correlated scores (samples, n)."""
    lag = _optimal_lag(scores) if lag is None else lag
    window = 1 - np.abs(np.arange(-lag, lag + 1)) / (lag + 1)  # Bartlett's
    found = sum(s.T @ signal.convolve(s, window[:, None], mode="same") for s in scores)
    return np.asarray(found + np.transpose(found)) / 2


def _optimal_lag(scores: Sequence[np.ndarray]) -> int:
    """Compute Andrews' optimal lag of Bartlett's window, for first-order autoregressive scores."""
    before = np.concatenate([s[:-1] for s in scores])
    after = np.concatenate([s[1:] for s in scores])
    power = np.sum(before**2, 0)
    rho = np.clip(np.sum(after * before, 0) / np.where(power > 0, power, 1.0), -0.99, 0.99)
    s4 = np.mean((after - rho * before) ** 2, 0) ** 2
    top = np.sum(4 * rho**2 * s4 / ((1 - rho) ** 6 * (1 + rho) ** 2))
    alpha = top / max(np.sum(s4 / (1 - rho) ** 4), 1e-300)
    longest = max(map(len, scores))
    return int(min(np.ceil(1.1447 * (alpha * longest) ** (1 / 3)), longest - 1))


#: a column with a smaller range, relative to its largest value, is constant up to rounding
CONSTANT = 1e-9


def varies(recorded: np.ndarray) -> np.ndarray:
    """Check for each column of (T, n) whether it varies. NaN is ignored."""
    found = np.zeros(recorded.shape[1], bool)
    some = ~np.isnan(recorded).all(0)
    y = recorded[:, some]
    size = np.nanmax(np.abs(y), 0, initial=0.0)
    found[some] = np.nanmax(y, 0, initial=-np.inf) - np.nanmin(y, 0, initial=np.inf) > (
        CONSTANT * size
    )
    return found


def explained(recorded: Iterable[np.ndarray], residuals: Iterable[np.ndarray]) -> float:
    """Compute R2 = 1 - sum r^2 / sum (y - mean)^2 of recordings (T, n).

    The mean is taken for each column in each recording. Return nan if every column is constant.
    """
    left = there = 0.0
    for y, r in zip(recorded, residuals, strict=True):
        left += float(np.nansum(r**2))
        moving = varies(y)
        there += float(np.nansum((y[:, moving] - np.nanmean(y[:, moving], 0)) ** 2))
    return 1 - left / there if there > 0 else np.nan
