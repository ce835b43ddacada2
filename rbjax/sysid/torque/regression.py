"""Linear regression of torques on base parameters: tau = W pi + e.

X are the kept columns of W, beta the base parameters, and S the covariance of the noise:

    ordinary      beta = (X^T X)^-1 X^T tau
    weighted      beta = (X^T S^-1 X)^-1 X^T S^-1 tau,   covariance (X^T S^-1 X)^-1
    robust        iteratively weighted, with weights psi(u) / u of the residuals u = e / s
    instrumental  beta = (Z^T X)^-1 Z^T tau

Noise in q, v and a makes X noisy, and biases the first three estimators, mostly towards zero.
Instruments Z are columns without that noise, such as the columns of a simulated motion. Gautier
1997 (weights); Huber & Ronchetti, *Robust Statistics*, 2009, ch. 7; Janot, Vandanjon & Gautier,
IEEE Trans. Control Systems Technology 22(1), 2014 (instruments).

An estimator is a function of `Equations` that returns a `Regression`.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import scipy.linalg
import scipy.stats

from rbjax.arguments import choice, integer
from rbjax.errors import InputError
from rbjax.status import Status
from rbjax.sysid.statistics.rank import Combinations
from rbjax.sysid.statistics.residual_tests import long_run_covariance
from rbjax.sysid.torque.torque_equations import (
    ROUNDING,
    Equations,
    Regression,
    equations,
    negligible,
    statistics_of,
    with_statistics,
)

Array = np.ndarray


def regress(
    W: Any,
    tau: Any,
    names: Sequence[str],
    *,
    method: str | Callable[..., Regression] = "weighted",
    noise: Any = None,
    base: Combinations | None = None,
    lengths: Sequence[int] | None = None,
    **options: Any,
) -> Regression:
    """Fit base parameters to measured torques by linear regression.

    Use it if positions, velocities, accelerations and torques are measured. `torque_rows` filters
    them. `consistent` fits physically consistent inertias.

    Args:
        W: (N, k, p) observation matrix of k channels, or (N, p) of one channel.
        tau: (N, k) or (N,) measured torques in N m or N.
        names: (p,) names of the columns.
        method: "ordinary", "weighted", "robust", "instrumental", or a function of `Equations`
            (rbjax/sysid/torque/torque_equations.py) and options that returns a `Regression`.
        noise: standard deviation of tau if known, one number, (k,) or (N, k). inf: zero weight.
        base: the combinations to fit. None: the combinations that W identifies.
        lengths: number of samples of each recording in W, N in all. Noise is not correlated between
            recordings. Samples are in the order of time. None: one recording.
        options: options of the method. robust: loss ("huber", "bisquare"), max_steps. instrumental:
            instruments (N, k, p), or a function of the last `Regression` that returns them; start;
            max_steps.

    Returns:
        `Regression`. `success` is False if the iteration did not converge.

    Raises:
        UnknownName: an unknown method or option.
        InputError: inconsistent shapes, values that are not finite, or too few samples.

    Source: Swevers, Verdonck & De Schutter, IEEE Control Systems 27(5), 2007.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.torque import regress
        >>> t = np.linspace(0.0, 1.0, 20)
        >>> line = np.stack([np.ones(20), t], 1)
        >>> found = regress(line, line @ [2.0, -1.0], ["offset", "slope"])
        >>> found.beta.round(6).tolist()
        [2.0, -1.0]
    """
    estimator = (
        method if callable(method) else METHODS[choice("regression method", method, METHODS)]
    )
    known = inspect.signature(estimator).parameters
    for option in options:
        choice(f"option of method {method}", option, list(known)[1:])
    if method == "instrumental" and "instruments" not in options:
        raise InputError(
            "regress: method instrumental without instruments, expected an array (N, k, p) like W, "
            "or a function of the last Regression that returns it"
        )
    eq = equations(W, tau, names, noise=noise, base=base, lengths=lengths)
    return estimator(eq, **options)


def ordinary(eq: Equations) -> Regression:
    """Fit by ordinary least squares, with equal noise in all channels if it is not given."""
    fitted, (N, k) = eq.fit(1.0), eq.tau.shape
    beta, covariance = fitted.beta, fitted.covariance
    residual = eq.tau - eq.X @ beta
    if eq.noise is None:
        dof = float(eq.tau.size - beta.size)
        noise = np.full(k, np.sqrt((residual**2).sum() / dof))
        covariance = noise[0] ** 2 * covariance
    else:
        if not eq.counted.all():
            raise InputError(
                "regress: noise is inf for some torques, but by method ordinary all count alike; "
                "use method weighted, or leave these samples out"
            )
        dof, noise = np.inf, np.sqrt((eq.noise**2).mean(0))
        noisy = (eq.X * eq.noise[..., None]).reshape(-1, beta.size) @ covariance
        covariance = noisy.T @ noisy
    found = Regression(
        eq.combinations, beta, covariance, noise, residual, np.ones((N, k)), dof
    )  # fmt: skip
    return with_statistics(eq, found, np.ones((N, k)))


def weighted(eq: Equations) -> Regression:
    """Fit by least squares weighted by the noise, which is given or estimated for each channel."""
    sd = _noise_of_channels(eq) if eq.noise is None else eq.noise
    return with_statistics(eq, _weighted(eq, sd), np.broadcast_to(sd, eq.tau.shape))


def _noise_of_channels(eq: Equations) -> Array:
    beta = eq.fit(1.0).beta
    noise = _floor(eq, np.sqrt(((eq.tau - eq.X @ beta) ** 2).mean(0)))
    for _ in range(3):  # noise and weights converge fast
        noise = _floor(eq, _weighted(eq, noise).noise)
    return noise


def robust(eq: Equations, *, loss: str = "huber", max_steps: int = 100) -> Regression:
    """Fit by iteratively reweighted least squares, with small weights psi(u) / u for outliers.

    "huber" bounds the influence of a sample. "bisquare" starts from the "huber" fit and ignores
    samples farther than 4.7 standard deviations. The scale of a channel is the median of |u| /
    0.6745. The covariance is that of weighted least squares times mean psi^2 / (mean psi')^2
    (Huber).
    """
    choice("loss", loss, LOSSES)
    integer("robust", "max_steps", max_steps, least=1)
    sd = _noise_of_channels(eq) if eq.noise is None else eq.noise
    found, done, step = _weighted(eq, sd), False, 0
    stages = ["huber"] if loss == "huber" else ["huber", loss]
    for stage in stages:
        for _ in range(max_steps):
            step += 1
            scale = _scale(eq, found.residual)
            w, _, _ = LOSSES[stage](found.residual / scale)
            beta = eq.fit(scale / np.sqrt(np.maximum(w, 1e-12))).beta
            residual = eq.tau - eq.X @ beta
            moved = np.abs(eq.X @ (beta - found.beta)) / scale  # in sigmas of tau
            done = bool(moved.max() < 1e-8)
            found = Regression(
                eq.combinations, beta, found.covariance, found.noise, residual, w, found.dof
            )
            if done:
                break
    scale = _scale(eq, found.residual)
    w, psi, slope = LOSSES[loss](found.residual / scale)
    # `with_statistics` keeps this covariance if the noise is given and the samples are few
    counted = eq.counted
    spread = (psi[counted] ** 2).mean() / max(slope[counted].mean(), 1e-3) ** 2
    size = np.where(counted, scale, 0.0)
    size = np.sqrt((size**2).sum(0) / np.maximum(counted.sum(0), 1))
    found = Regression(
        eq.combinations, found.beta, spread * eq.fit(scale).covariance,
        size, found.residual, w, float(counted.sum() - found.beta.size), step,
        Status.of(done),
    )  # fmt: skip
    return with_statistics(eq, found, scale, psi, slope)


def instrumental(
    eq: Equations,
    *,
    instruments: Any,
    start: Regression | None = None,
    max_steps: int = 20,
    tolerance: float = 1e-3,
) -> Regression:
    """Fit with instrumental variables Z, which removes the bias from noise in X.

    `instruments` is an array (N, k, p) like W, or a function of the last `Regression` that returns
    such an array, for example the observation matrix of a motion simulated with its parameters. For
    a function, the estimate is repeated from `start` (None: weighted least squares) until no base
    parameter changes by more than `tolerance` standard deviations.
    """
    integer("instrumental", "max_steps", max_steps, least=1)
    found, (N, k) = weighted(eq) if start is None else start, eq.tau.shape
    count = int(eq.counted.sum())
    steps = max_steps if callable(instruments) else 3  # the noise of channels converges fast
    for step in range(1, steps + 1):
        Z = np.asarray(instruments(found) if callable(instruments) else instruments, float)
        if Z.shape != eq.W.shape or not np.isfinite(Z).all():
            raise InputError(
                f"instrumental: instruments have shape {Z.shape}, expected {eq.W.shape} as W, "
                "finite"
            )
        given = eq.noise is not None
        sd = eq.noise if eq.noise is not None else _floor(eq, found.noise)
        X, y = _stacked(eq, sd)
        Zs, _ = _stacked(dataclasses.replace(eq, W=Z), sd)
        size = np.linalg.norm(Zs, axis=0)
        if not size.all():
            name = eq.combinations.names[eq.combinations.kept[int(np.argmin(size))]]
            raise InputError(f"instrumental: the instruments do not show {name}")
        Zs = Zs / size
        try:
            solve = scipy.linalg.solve(Zs.T @ X, Zs.T)
        except np.linalg.LinAlgError as error:
            raise InputError(
                "instrumental: Z^T X is singular, the instruments do not show all base parameters"
            ) from error
        beta = solve @ y
        residual = eq.tau - eq.X @ beta
        dof = np.inf if given else float(count - beta.size)
        noise = np.sqrt((np.where(eq.counted, residual, 0) ** 2).sum(0) * k / (count - beta.size))
        covariance = solve @ solve.T
        moved = (np.abs(beta - found.beta) / np.sqrt(covariance.diagonal())).max()
        found = Regression(
            eq.combinations, beta, covariance, noise, residual, np.ones((N, k)), dof, step,
            Status.of(bool(moved < tolerance) or not callable(instruments)),
        )  # fmt: skip
        if callable(instruments) and found.success:
            break
    statistics = statistics_of(
        eq, found.residual / sd, np.ones((N, k)), np.broadcast_to(sd, (N, k))
    )
    if statistics.white or negligible(eq, found.residual):
        return found
    scores = np.split(
        np.einsum("nkr,nk->nr", Zs.reshape(N, k, -1), found.residual / sd),
        np.cumsum(eq.lengths)[:-1],
    )
    bread = scipy.linalg.inv(Zs.T @ X)
    covariance = bread @ long_run_covariance(scores) @ bread.T
    covariance = covariance * (count / (count - found.beta.size))
    return dataclasses.replace(
        found, covariance=covariance, dof=statistics.estimates.dof, white=False
    )


def _huber(u: Array, c: float = 1.345) -> tuple[Array, Array, Array]:
    psi = np.clip(u, -c, c)
    return _weight(psi, u), psi, (np.abs(u) <= c).astype(float)


def _bisquare(u: Array, c: float = 4.685) -> tuple[Array, Array, Array]:
    x = np.minimum((u / c) ** 2, 1.0)
    return (1 - x) ** 2, u * (1 - x) ** 2, (1 - x) * (1 - 5 * x)


def _weight(psi: Array, u: Array) -> Array:
    return np.where(u == 0, 1.0, psi / np.where(u == 0, 1.0, u))


#: loss -> function of residuals u (in standard deviations) that returns psi(u) / u, psi and psi'.
#: The efficiency is 95 % of that of least squares for normal noise.
LOSSES: dict[str, Callable[[Array], tuple[Array, Array, Array]]] = {
    "huber": _huber,
    "bisquare": _bisquare,
}

METHODS: dict[str, Callable[..., Regression]] = {
    "ordinary": ordinary,
    "weighted": weighted,
    "robust": robust,
    "instrumental": instrumental,
}
"""The estimators of `regress`: name -> function of `Equations` and options."""


def _weighted(eq: Equations, noise: Array) -> Regression:
    fitted = eq.fit(noise)
    residual = eq.tau - eq.X @ fitted.beta
    # degrees of freedom of each channel: number of samples minus leverage
    count = eq.counted.sum(0)
    free = np.maximum(count - fitted.leverage, 1e-3 * np.maximum(count, 1))
    found = np.sqrt((np.where(eq.counted, residual, 0.0) ** 2).sum(0) / free)
    ones = np.ones_like(residual)
    dof = np.inf if eq.noise is not None else float(eq.tau.size - fitted.beta.size)
    return Regression(eq.combinations, fitted.beta, fitted.covariance, found, residual, ones, dof)


def _stacked(eq: Equations, noise: Any) -> tuple[Array, Array]:
    """Stack the columns X (N k, r) of the base parameters and the torques (N k,), divided by the
    noise."""
    sd = np.broadcast_to(noise, eq.tau.shape)
    return (eq.X / sd[..., None]).reshape(eq.tau.size, -1), (eq.tau / sd).ravel()


def _floor(eq: Equations, noise: Array) -> Array:
    """Raise the noise of channels to at least the rounding level."""
    size = np.sqrt((eq.tau**2).mean(0))
    return np.maximum(noise, ROUNDING * max(size.max(), np.finfo(float).tiny / ROUNDING))


def _scale(eq: Equations, residual: Array) -> Array:
    """Return the noise scale of each sample, either given or a robust estimate for its channel."""
    if eq.noise is not None:
        return eq.noise
    each = np.median(np.abs(residual), axis=0) / 0.6745
    return np.broadcast_to(_floor(eq, each), residual.shape)
