"""Linear equations W pi = tau + noise, their weighted least squares, and residual statistics.

X, the columns of the base parameters, is factored once, X = Q R. For weights 1 / s the solution is
A z = Q^T S^-2 tau with A = Q^T S^-2 Q, and R beta = z. A has the condition number of the weights. A
change of the weights costs one matrix product.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg
import scipy.stats

from rbjax.arguments import instance
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.status import HasStatus, Status
from rbjax.sysid.statistics.fit_statistics import (
    FEW,
    FitColumn,
    FitRows,
    FitStatistics,
    fit_statistics,
)
from rbjax.sysid.statistics.intervals import student_quantile
from rbjax.sysid.statistics.rank import Combinations, combinations

Array = np.ndarray
#: Noise below this multiple of the torque is rounding.
ROUNDING = 1e-13
#: Residuals below this multiple of the given noise are not used to estimate the noise.
SMALL = 1e-6


@displayed
class Fitted(NamedTuple):
    """A weighted least-squares solution.

    Fields:
        beta: (r,) base parameters.
        covariance: (X^T S^-1 X)^-1 (r, r).
        leverage: (k,) number of parameters that each channel determines.
    """

    beta: Array
    covariance: Array
    leverage: Array


@displayed
@dataclass(frozen=True, eq=False)
class Equations:
    """Samples of the linear equations W pi = tau.

    Fields:
        W: (N, k, p) observation matrix.
        tau: (N, k) torques.
        combinations: identifiable combinations of the p parameters.
        noise: (N, k) standard deviation of each torque, inf for zero weight; None if unknown.
        lengths: number of samples of each successive recording, N in all.
    """

    W: Array
    tau: Array
    combinations: Combinations
    noise: Array | None = None
    lengths: tuple[int, ...] = ()

    @property
    def counted(self) -> Array:
        """The mask (N, k) of torques with a nonzero weight, which have finite noise."""
        return np.isfinite(np.zeros(self.tau.shape) if self.noise is None else self.noise)

    @cached_property
    def X(self) -> Array:
        """The columns (N, k, r) of the base parameters."""
        return self.W[..., list(self.combinations.kept)]

    @cached_property
    def factors(self) -> tuple[Array, Array]:
        """The QR factors Q and R of X."""
        X = self.X.reshape(self.tau.size, -1)
        size = np.linalg.norm(X, axis=0)
        if not size.all():
            raise InputError(
                f"regress: {self.combinations.term(int(np.argmin(size)))} moves nothing in these "
                "samples; leave `base` out, so that it follows from them"
            )
        Q, R = np.linalg.qr(X / size)
        return Q, R * size

    def fit(self, noise: Any) -> Fitted:
        """Solve the least-squares problem of rows divided by their noise.

        The unknowns are R beta, with the factor R of a QR decomposition. They are solved by normal
        equations, or by QR if the weights differ by too many decades.
        """
        Q, R = self.factors
        sd = np.broadcast_to(noise, self.tau.shape).reshape(-1, 1)
        Qs, y = Q / sd, self.tau.reshape(-1, 1) / sd
        A = Qs.T @ Qs
        w = np.linalg.eigvalsh(A)
        if w[0] > 1e-8 * w[-1]:
            L = np.linalg.cholesky(A)
            z = scipy.linalg.cho_solve((L, True), Qs.T @ y)
            z = z + scipy.linalg.cho_solve((L, True), Qs.T @ (y - Qs @ z))  # refined
            upper = L.T
        else:
            orthonormal, upper = np.linalg.qr(Qs)
            z = scipy.linalg.solve_triangular(upper, orthonormal.T @ y)
        half = scipy.linalg.solve_triangular(upper @ R, np.eye(len(R)))
        leverage = (scipy.linalg.solve_triangular(upper, Qs.T, trans="T") ** 2).sum(0)
        beta = scipy.linalg.solve_triangular(R, z[:, 0])
        return Fitted(beta, half @ half.T, leverage.reshape(self.tau.shape).sum(0))


def equations(
    W: Any, tau: Any, names: Sequence[str], *, noise: Any = None, base: Combinations | None = None,
    lengths: Sequence[int] | None = None,
) -> Equations:  # fmt: skip
    """Check the equations W pi = tau, the input of the estimators of `regress`.

    Args:
        W: (N, k, p), regressor of N samples.
        tau: (N, k), torques, N m or N.
        names: (p,), names of the parameters.
        noise: standard deviation of the torques: a number, or (k,), N m or N; None to estimate it.
        base: the `Combinations` of another data set; None for those of W.
        lengths: numbers of samples of the recordings; None for one recording.

    Returns:
        `Equations`.

    Raises:
        InputError: shapes that do not fit, values that are not finite, or fewer torques than
            parameters.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.torque.torque_equations import equations
        >>> t = np.linspace(0.0, 1.0, 20)
        >>> line = equations(np.stack([np.ones(20), t], 1), 2.0 - t, ["offset", "slope"])
        >>> line.fit(0.1).beta.round(6).tolist()
        [2.0, -1.0]
    """
    try:
        given, tau = np.asarray(W), np.asarray(tau, float)
        names = tuple(names)
        noise = None if noise is None else np.asarray(noise, float)
        if given.dtype.kind not in "biuf":
            raise TypeError(f"W has dtype {given.dtype}")
    except (TypeError, ValueError) as error:
        raise InputError(
            f"regress: {error}; expected arrays of numbers W (N, k, p) and tau (N, k), p names, "
            "and noise as numbers or None"
        ) from error
    if given.ndim == 2:
        given, tau = given[:, None], tau.reshape(-1, 1) if tau.ndim == 1 else tau
    W = given.astype(float)
    if W.ndim != 3 or tau.shape != W.shape[:2] or W.shape[2] != len(names):
        raise InputError(
            f"regress: W has shape {given.shape}, tau {tau.shape} and there are {len(names)} "
            "names, expected (N, k, p), (N, k) and p"
        )
    for name, x in (("tau", tau), ("W", W)):
        if not np.isfinite(x).all():
            at = np.argwhere(~np.isfinite(x))[0]
            raise InputError(
                f"regress: {name}[{', '.join(map(str, at))}] is {x[tuple(at)]}, expected finite "
                "values; leave samples that are missing out"
            )
    base = combinations(given, names) if base is None else base
    instance("regress", "base", base, Combinations, "the Combinations of `combinations`")
    if base.names != tuple(names):
        raise InputError("regress: base has other names than the columns of W")
    if not base.rank or tau.size <= base.rank:
        raise InputError(
            f"regress: {tau.size} torques for {base.rank} base parameters, expected more torques "
            "than parameters, and at least one parameter that shows"
        )
    if noise is not None:
        noise = _checked_noise(noise, tau, base.rank)
    given_lengths: Any = (len(tau),) if lengths is None else lengths
    lengths = tuple(given_lengths) if isinstance(given_lengths, Iterable) else (given_lengths,)
    if not all(isinstance(n, (int, np.integer)) and n > 0 for n in lengths) or sum(lengths) != len(
        tau
    ):
        raise InputError(
            f"regress: lengths is {lengths}, expected the number of samples of each recording, "
            f"{len(tau)} in all"
        )
    return Equations(W, tau, base, noise, lengths)


def _checked_noise(noise: Array, tau: Array, rank: int) -> Array:
    """Check the noise, and return the noise of each torque (N, k)."""
    shapes = f"(), {tau.shape[1:]} or {tau.shape}"
    if noise.shape not in ((), tau.shape[1:], tau.shape):
        raise InputError(f"regress: noise has shape {noise.shape}, expected {shapes}")
    wrong = np.argwhere(~(noise > 0))
    if len(wrong):
        at = tuple(wrong[0])
        place = f"[{', '.join(map(str, at))}]" if at else ""
        raise InputError(
            f"regress: noise{place} is {noise[at]}, expected standard deviations above 0, inf for "
            "a torque that does not count"
        )
    noise = np.broadcast_to(noise, tau.shape)
    count = int(np.isfinite(noise).sum())
    if count <= rank:
        raise InputError(
            f"regress: {count} torques have finite noise, for {rank} base parameters; expected "
            "more torques than parameters"
        )
    return noise


@displayed
@dataclass(frozen=True, eq=False)
class Regression(HasStatus):
    """The result of a regression.

    Fields:
        combinations: the r base parameters as combinations of the parameters.
        beta: (r,) estimates.
        covariance: (r, r), for independent noise if the residuals are white, otherwise for noise
            with the correlation of the residuals.
        noise: (k,) standard deviation of each channel.
        residual: (N, k) tau - W pi.
        weights: (N, k) robust weights, below 1 for outliers.
        dof: degrees of freedom of Student's t; inf if the noise is given and the residuals agree
            with it.
        steps: number of iterations.
        status: a `Status`.
        white: whether the residuals of each channel are independent in time.
    """

    combinations: Combinations
    beta: Array
    covariance: Array
    noise: Array
    residual: Array
    weights: Array
    dof: float
    steps: int = 1
    status: Status = Status.CONVERGED
    white: bool = True

    @property
    def errors(self) -> Array:
        """The standard deviations (r,) of beta."""
        return np.sqrt(np.diag(self.covariance))

    def intervals(self, level: float = 0.95) -> Array:
        """Compute the confidence intervals (r, 2) of the base parameters."""
        half = student_quantile("intervals", level, self.dof) * self.errors
        return np.stack([self.beta - half, self.beta + half], 1)

    def parameters(self, prior: Any) -> Array:
        """Compute all parameters (p,) from beta and a prior.

        Dropped parameters are equal to `prior`, and the kept ones follow from beta. The inertias
        may be physically inconsistent; `consistent` avoids this.
        """
        c = self.combinations
        out = np.array(prior, float)
        if out.shape != (len(c.names),):
            raise InputError(f"parameters: prior has shape {out.shape}, expected ({len(c.names)},)")
        out[list(c.kept)] = self.beta - c.K @ out[list(c.dropped)]
        return out

    def summary(self, level: float = 0.95) -> str:
        """Return the base parameters with their intervals as text, one a line."""
        rows = zip(self.combinations.terms(), self.beta, self.intervals(level), strict=True)
        return "\n".join(f"{term} = {x:.5g} ({low:.5g} to {up:.5g})" for term, x, (low, up) in rows)


def with_statistics(
    eq: Equations, found: Regression, sd: Array, psi: Array | None = None,
    slope: Array | None = None,
) -> Regression:  # fmt: skip
    """Set the covariance of a regression from its residuals by `fit_statistics`.

    Given noise is used unless the residuals contradict it with at least `FEW` degrees of freedom.
    """
    psi = found.residual / sd if psi is None else psi
    slope = np.ones_like(psi) if slope is None else slope
    free = int(eq.counted.sum()) - found.beta.size
    if negligible(eq, found.residual) or (eq.noise is not None and free < FEW):
        return found
    statistics = statistics_of(eq, psi, slope, sd)
    agrees = eq.noise is not None and statistics.white and _agrees(eq, found.residual)
    if agrees and np.isinf(found.dof):
        return found
    dof = float(free) if statistics.white else statistics.estimates.dof
    return dataclasses.replace(
        found, covariance=statistics.estimates.covariance, dof=dof, white=statistics.white
    )


def _agrees(eq: Equations, residual: Array) -> bool:
    """Test whether the residuals agree with the given noise (chi-square, 1 % on each side)."""
    assert eq.noise is not None
    free = int(eq.counted.sum()) - eq.combinations.rank
    squares = float(((residual / eq.noise) ** 2).sum())
    low, high = scipy.stats.chi2.ppf([0.01, 0.99], free)
    return bool(low <= squares <= high)


def negligible(eq: Equations, residual: Array) -> bool:
    """Check whether the residuals are rounding, or negligible compared with the given noise."""
    size = np.abs(residual[eq.counted]).max()
    if eq.noise is not None and size < SMALL * eq.noise.min():
        return True
    return bool(size <= 100 * ROUNDING * np.abs(eq.tau).max())


def statistics_of(eq: Equations, psi: Array, slope: Array, sd: Array) -> FitStatistics:
    """Compute the statistics of residuals psi (N, k) in units of their standard deviation."""
    X = eq.X / sd[..., None]
    ends = np.cumsum([0, *eq.lengths])
    columns = [
        FitColumn(
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


def _rows(counted: Array, X: Array, psi: Array, slope: Array) -> FitRows:
    """Select the rows of a channel in a recording that have a nonzero weight."""
    which = np.arange(X.shape[-1])
    return FitRows(X[counted], psi[counted], slope[counted], np.flatnonzero(counted), which)
