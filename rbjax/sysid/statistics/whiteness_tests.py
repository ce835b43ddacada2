"""Whether residuals are white, and what is left of the intervals if they are not.

Residuals of a model that lacks something are correlated in time. Then there are fewer independent
samples than samples, and the covariance s^2 (J^T J)^-1 is too small, often by a factor of 10 or
more. The sandwich uses the residuals' own correlations:
    cov = H^-1 (sum_|l|<=L (1 - |l|/(L+1)) sum_k s_k s_(k+l)^T) H^-1,  H = J^T J,  s_k = J_k^T r_k
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import signal, stats

from rbjax.arguments import integer
from rbjax.errors import InputError
from rbjax.sysid.arguments import floats

ALPHA = 0.01  # a p value below it is no chance


@dataclass(frozen=True, eq=False)
class Whiteness:
    """Ljung and Box's test of a residual.

    Fields: statistic; p_value; correlation (lags,) at lags 1, 2, ...; effective_samples, how many
    independent samples say as much of a mean; white, whether p_value is at least 1 %; sentence.
    """

    statistic: float
    p_value: float
    correlation: np.ndarray
    effective_samples: float
    white: bool
    sentence: str


def whiteness(residual: Any, lags: int | None = None) -> Whiteness:
    """Whether a residual is white noise.

    Q = n (n + 2) sum_(k<=h) rho_k^2 / (n - k), of chi-squared with h degrees of freedom if so.

    Args:
        residual: (samples,) on an even clock, of one channel of one recording.
        lags: h; the lesser of 20 and a fifth of the samples if None.

    Returns:
        `Whiteness`.

    Raises:
        InputError: fewer than 10 samples, numbers that are not finite or all equal.

    Source: Ljung & Box 1978; Geyer 1992 (effective samples, initial positive sequence).

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.statistics import whiteness
        >>> noise = np.random.default_rng(0).normal(size=500)
        >>> whiteness(noise).white, whiteness(np.cumsum(noise)).white
        (True, False)
    """
    r = floats("whiteness", "residual", residual)
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
    p = float(stats.chi2.sf(statistic, h))
    pairs = every[: 2 * (n // 2)].reshape(-1, 2).sum(1)  # positive for a reversible process
    first = int((pairs <= 0).argmax()) if (pairs <= 0).any() else len(pairs)
    effective = n / max(1.0, 2 * pairs[:first].sum() - 1)
    white = p >= ALPHA
    sentence = f"the residual is white (Ljung-Box p = {p:.2g})"
    if not white:
        sentence = (
            f"the residual is not white (Ljung-Box p = {p:.1g}): {n} samples say as much as "
            f"{effective:.0f}, so intervals for white noise are too narrow, and the model lacks "
            "something"
        )
    return Whiteness(statistic, p, rho, float(effective), white, sentence)


def meat_of(scores: Sequence[np.ndarray], lag: int | None = None) -> np.ndarray:
    """The long-run covariance (n, n) of the sum of scores, one (samples, n) a recording."""
    lag = _andrews(scores) if lag is None else lag
    meat = np.zeros((scores[0].shape[1],) * 2)
    for s in scores:
        meat += s.T @ s
        for k in range(1, min(lag, len(s) - 1) + 1):
            cross = s[k:].T @ s[:-k]
            meat += (1 - k / (lag + 1)) * (cross + cross.T)
    return meat


def _andrews(scores: Sequence[np.ndarray]) -> int:
    """The lag of least error of Bartlett's window for scores that are first-order processes."""
    before = np.concatenate([s[:-1] for s in scores])
    after = np.concatenate([s[1:] for s in scores])
    power = np.sum(before**2, 0)
    rho = np.clip(np.sum(after * before, 0) / np.where(power > 0, power, 1.0), -0.99, 0.99)
    s4 = np.mean((after - rho * before) ** 2, 0) ** 2
    top = np.sum(4 * rho**2 * s4 / ((1 - rho) ** 6 * (1 + rho) ** 2))
    alpha = top / max(np.sum(s4 / (1 - rho) ** 4), 1e-300)
    longest = max(map(len, scores))
    return int(min(np.ceil(1.1447 * (alpha * longest) ** (1 / 3)), longest - 1))
