"""Covariance and confidence intervals of estimates.

The residuals are r(p) = y - f(p), with independent noise of variance S, and J = df/dp. In the limit
of small noise (exactly for a linear f):
    information  F = J^T S^-1 J        covariance of the best estimate, the Cramer-Rao bound, F^-1
A combination c(p) with gradient g has the variance g^T F^-1 g if g has no component in the null
space of J. Otherwise c is not identifiable, and its interval is infinite.
Intervals of positive and bounded parameters are symmetric in log(p - low), or in the logit, and
remain within the bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import linalg, special, stats

from rbjax.arguments import choice, instance, real_array, real_number
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.rank_tolerances import rank_tolerance
from rbjax.sysid.arguments import names_of, positive_numbers

NULL_SHARE = 1e-5  # a smaller share of a gradient in the null space counts as rounding


class Interval(NamedTuple):
    """A value with its confidence interval, all in the unit of the value.

    Fields:
        value: the estimate.
        sigma: its standard deviation; inf if it is not identifiable.
        low: lower bound of the interval.
        high: upper bound of the interval.
    """

    value: float
    sigma: float
    low: float
    high: float


@displayed
@dataclass(frozen=True, eq=False)
class Estimates:
    """Estimates with their covariance.

    Fields:
        names: (n,) names of the parameters.
        values: (n,) estimates.
        covariance: (n, n) covariance in the identifiable directions.
        free: (n, k) unidentifiable directions, as columns of unit length.
        dof: degrees of freedom of the estimated noise; inf if the noise is known.
        bounds: name -> (low, high), the physical range of a parameter.
        lengths: (n,) lengths of the columns of the Jacobian of the residuals, which scale the
            parameters.
    """

    names: tuple[str, ...]
    values: np.ndarray
    covariance: np.ndarray
    free: np.ndarray
    dof: float = np.inf
    bounds: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    lengths: np.ndarray | None = None

    def interval(
        self,
        of: str | Mapping[str, float] | Callable[[dict[str, Any]], Any],
        level: float = 0.95,
        bounds: tuple[float, float] | None = None,
    ) -> Interval:
        """Compute the confidence interval of a parameter or of a combination of parameters.

        Args:
            of: a name; a linear combination as name -> coefficient; or a function of the dict name
                -> value, written with jax.numpy, such as `lambda p: p["b"] / p["m"]` (delta
                method).
            level: share of experiments with an interval that contains the true value.
            bounds: bounds of the combination. None: the bounds of the parameter.

        Returns:
            `Interval`, by Student's t with `dof`. If the combination is not identifiable, it
            extends from bound to bound, with sigma inf.

        Raises:
            UnknownName: an unknown parameter.
            InputError: a level outside of (0, 1).
        """
        t = student_quantile("interval", level, self.dof)
        value, gradient = self._combination(of)
        if bounds is None:
            bounds = self.bounds.get(of, (-np.inf, np.inf)) if isinstance(of, str) else None
        low, high = bounds or (-np.inf, np.inf)
        if not self._identifies(gradient):
            return Interval(value, np.inf, low, high)
        sigma = float(np.sqrt(max(gradient @ self.covariance @ gradient, 0.0)))
        return Interval(value, sigma, *_within(value, t * sigma, low, high))

    @property
    def sigma(self) -> np.ndarray:
        """The standard deviations (n,) of the estimates; inf for an unidentifiable parameter."""
        return np.array([self.interval(n).sigma for n in self.names])

    @property
    def correlation(self) -> np.ndarray:
        """The correlation matrix (n, n) of the estimates, in the identifiable directions."""
        sigma = np.sqrt(np.diag(self.covariance))
        sigma[sigma == 0] = 1.0
        return self.covariance / np.outer(sigma, sigma)

    def sentences(self, level: float = 0.95) -> list[str]:
        """Return one sentence for each parameter, and one for each unidentifiable direction."""
        lines = []
        for n in self.names:
            x = self.interval(n, level)
            if np.isinf(x.sigma):
                lines.append(f"{n}: these data do not identify it")
            else:
                lines.append(f"{n} = {x.value:.6g}, {level:.0%} from {x.low:.6g} to {x.high:.6g}")
        for direction in self.free.T:
            parts = [
                f"{x:+.3g} {n}" for n, x in zip(self.names, direction, strict=True) if abs(x) > 1e-6
            ]
            lines.append(f"free: a change along ({', '.join(parts)}) leaves the data as they are")
        return lines

    def _combination(self, of: Any) -> tuple[float, np.ndarray]:
        if isinstance(of, str):
            of = {of: 1.0}
        if isinstance(of, Mapping):
            gradient = np.zeros(len(self.names))
            for name, coefficient in of.items():
                choice("parameter", name, self.names)
                gradient[self.names.index(name)] = coefficient
            return float(gradient @ self.values), gradient
        at = dict(zip(self.names, map(float, self.values), strict=True))
        value, slopes = jax.value_and_grad(of)(at)
        return float(value), np.array([float(slopes[n]) for n in self.names])

    def _identifies(self, gradient: np.ndarray) -> bool:
        if not self.free.size:
            return True
        lengths = np.ones(len(self.names)) if self.lengths is None else self.lengths
        null = linalg.orth(self.free * lengths[:, None])
        scaled = gradient / lengths
        return bool(linalg.norm(null.T @ scaled) <= NULL_SHARE * linalg.norm(scaled))


def estimates(
    names: Sequence[str],
    values: Any,
    jacobian: Any,
    noise: Any = None,
    *,
    residual: Any = None,
    dof: float | None = None,
    bounds: Mapping[str, tuple[float, float]] | None = None,
) -> Estimates:
    """Compute the covariance of the parameters of a least-squares fit, for their intervals.

    cov = (J^T S^-1 J)^-1. S is the variance of the noise, or s^2 = r^T r / (m - rank) if unknown.

    Args:
        names: names of the n parameters.
        values: (n,) estimates.
        jacobian: (m, n) derivatives of the measurements by the parameters, at the estimates.
        noise: standard deviation of each row, (m,) or one number. None: estimate one number for all
            rows from `residual`.
        residual: (m,) residuals, if the noise is unknown.
        dof: degrees of freedom of `noise` if it is an estimate, such as m - n. None: inf.
        bounds: name -> (low, high), such as (0, inf) for positive parameters.

    Returns:
        `Estimates`. A relative singular value below 1e-9 (float32: 1e-4), for columns of unit
        length, counts as zero.

    Raises:
        InputError: wrong shapes, values that are not finite, or neither noise nor residual.

    Source: Seber & Wild, *Nonlinear Regression*, 2.1; Kay, *Estimation Theory*, 3.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.statistics import estimates
        >>> t = np.arange(5.0)
        >>> line = estimates(["offset", "slope"], [1.0, 2.0], np.stack([t**0, t], 1), noise=0.1)
        >>> [round(x, 3) for x in line.interval("slope")]
        [2.0, 0.032, 1.938, 2.062]
    """
    names = names_of("estimates", "names", names)
    values = real_array("estimates", "values", values, finite=False)
    tolerance = tolerance_for(jacobian)
    J = _rows("jacobian", jacobian, 2)
    m, n = J.shape
    if not len(names) == len(set(names)) == n == values.size:
        raise InputError(
            f"estimates: {len(names)} names and {values.size} values, expected {n} different ones, "
            "as the jacobian has columns"
        )
    instance("estimates", "bounds", bounds, Mapping | None, "a dict name -> (low, high)")
    for name, limits in (bounds or {}).items():
        choice("parameter", name, names)
        low_high = real_array("estimates", f"bounds of {name}", limits, "(low, high)", finite=False)
        if low_high.shape != (2,) or not low_high[0] < low_high[1]:
            raise InputError(f"estimates: bounds of {name} are {limits!r}, expected low < high")
    real_number("estimates", "dof", np.inf if dof is None else dof, above=0.0, finite=False)
    if noise is None:
        if residual is None:
            raise InputError("estimates: neither noise nor residual, expected one of them")
        r = _rows("residual", residual, 1, m)
        rank = decomposed(J, tolerance)[2].shape[1]
        if m <= rank:
            raise InputError(
                f"estimates: {m} residuals for {rank} parameters leave no noise to estimate, "
                "expected more samples, or the noise"
            )
        noise, dof = max(np.sqrt(r @ r / (m - rank)), np.finfo(float).tiny), m - rank
    sigma = positive_numbers("estimates", "noise", noise, m, "row")
    lengths, s, V, null = decomposed(J / sigma[:, None], tolerance)
    half = V / s / lengths[:, None]
    free = null / lengths[:, None]
    free = linalg.qr(free, mode="economic")[0] if free.size else free
    free = free * np.where(free.sum(0) < 0, -1.0, 1.0)
    return Estimates(
        names, values.ravel(), half @ half.T, free, np.inf if dof is None else float(dof),
        dict(bounds or {}), lengths,
    )  # fmt: skip


def student_quantile(where: str, level: float, dof: float) -> float:
    """Check a confidence level, and return the half width of its interval in standard deviations,
    by Student's t."""
    real_number(where, "level", level, "a number between 0 and 1", above=0.0)
    if not level < 1:
        raise InputError(f"{where}: level is {level}, expected a number between 0 and 1")
    return float(stats.t.ppf(0.5 + level / 2, dof))


def tolerance_for(jacobian: Any) -> float:
    """Return the rank tolerance for the dtype of a Jacobian."""
    return rank_tolerance("unknowns", jacobian.dtype if hasattr(jacobian, "dtype") else np.float64)


def decomposed(J: np.ndarray, tolerance: float) -> tuple[np.ndarray, ...]:
    """Compute the singular value decomposition of a J with scaled columns.

    Return the column lengths, and singular values, right vectors and null space of J / lengths.
    """
    lengths = linalg.norm(J, axis=0)
    lengths = np.where(lengths > 0, lengths, 1.0)
    scaled = J / lengths
    R = linalg.qr(scaled, mode="r")[0][: J.shape[1]] if len(J) > J.shape[1] else scaled
    _, s, Vt = linalg.svd(R, full_matrices=True)
    rank = int((s > tolerance * max(s[0], 1e-300)).sum()) if s.size and s[0] > 0 else 0
    return lengths, s[:rank], Vt[:rank].T, Vt[rank:].T


def _within(x: float, half: float, low: float, high: float) -> tuple[float, float]:
    """Compute an interval about x within (low, high), to first order x -+ half.

    It is symmetric in log(x - low), log(high - x) or their difference, for finite bounds.
    """
    if not low < x < high:  # the scale is undefined on a bound
        return max(x - half, low), min(x + half, high)
    if np.isinf(low) and np.isinf(high):
        return x - half, x + half
    if np.isinf(high):
        with np.errstate(over="ignore"):
            factor = np.exp(half / (x - low))
        return low + (x - low) / factor, low + (x - low) * factor
    if np.isinf(low):
        with np.errstate(over="ignore"):
            factor = np.exp(half / (high - x))
        return high - (high - x) * factor, high - (high - x) / factor
    u, du = np.log((x - low) / (high - x)), half * (1 / (x - low) + 1 / (high - x))
    span = high - low
    return low + span * float(special.expit(u - du)), low + span * float(special.expit(u + du))


def _rows(name: str, x: Any, ndim: int, rows: int | None = None) -> np.ndarray:
    """Check that x is a finite array with `ndim` axes and one row for each measurement."""
    x = real_array("estimates", name, x)
    if x.ndim != ndim or x.size == 0 or (rows is not None and len(x) != rows):
        due = "(m, n)" if ndim == 2 else f"({rows},)"
        raise InputError(f"estimates: {name} has shape {x.shape}, expected {due}")
    return x
