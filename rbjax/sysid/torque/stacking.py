"""The linear equations of a regression, W pi = tau + noise, and their weighted least squares.

X, the columns of the base parameters, is factored once, X = Q R. For weights 1 / s the problem is
then small, A z = Q^T S^-2 tau with A = Q^T S^-2 Q and R beta = z, and its condition is that of the
weights only: methods that change weights again and again cost one matrix product each time.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy.linalg

from rbjax.errors import InputError
from rbjax.sysid.statistics.rank import Combinations, combinations

Array = np.ndarray


class Fitted(NamedTuple):
    """beta (r,), (X^T S^-1 X)^-1 (r, r), and the parameters' share of each channel (k,)."""

    beta: Array
    covariance: Array
    leverage: Array


@dataclass(frozen=True, eq=False)
class Equations:
    """Samples of W pi = tau.

    Fields:
        W: (N, k, p).
        tau: (N, k).
        combinations: of the p parameters.
        noise: (N, k) standard deviation of each torque, inf for one that does not count, or None
            if it is to be estimated.
        lengths: samples of each recording, one after the other; N in all.
    """

    W: Array
    tau: Array
    combinations: Combinations
    noise: Array | None = None
    lengths: tuple[int, ...] = ()

    @property
    def counted(self) -> Array:
        """(N, k) whether a torque counts: its noise is not inf."""
        return np.isfinite(np.zeros(self.tau.shape) if self.noise is None else self.noise)

    @cached_property
    def X(self) -> Array:
        """(N, k, r) columns of the base parameters."""
        return self.W[..., list(self.combinations.kept)]

    @cached_property
    def factors(self) -> tuple[Array, Array]:
        """X = Q R, of which every choice of weights makes a small problem."""
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
        """Least squares of rows divided by their noise.

        By normal equations in the coordinates R beta, whose condition is that of the weights only,
        and by QR where the weights differ by too many decades for that.
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
    """W pi = tau, checked: what an estimator of `METHODS` takes.

    Args, Raises: as for `regress`.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.torque import equations
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
    if not isinstance(base, Combinations):
        raise InputError(
            f"regress: base is {type(base).__name__}, expected the Combinations of `combinations`"
        )
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
    """The noise (N, k) of each torque; inf means that the torque does not count."""
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
