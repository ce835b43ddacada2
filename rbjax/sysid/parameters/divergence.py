"""Divergences: distances of parameters from a guess, infinite outside of their range.

D(p, p0) is convex in p. It is the Bregman divergence of -log det, for numbers and for matrices:

    positive    sum p / p0 - log(p / p0) - 1
    inertia     tr(P0^-1 P) - log det(P0^-1 P) - 4,   P the pseudo-inertia
    free        sum ((p - p0) / scale)^2 / 2

Source: Lee, Wensing & Park, *Geometric robot dynamic identification*, IEEE T-RO 36(2), 2020.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rbjax.display import displayed

#: a thinner body, relative to the guess, counts as impossible because of rounding
BORDER = 1e-7
#: the state of `np.errstate` for trial steps that a line search rejects
TRIAL: Any = {"over": "ignore", "invalid": "ignore", "divide": "ignore"}


@displayed
@dataclass(frozen=True)
class Divergence:
    """The value D >= 0 of a divergence at p, with its gradient (n,) and Hessian (n, n).

    The value is inf if p is impossible or far away. NumPy then warns, unless the caller sets
    `np.errstate(**TRIAL)`. Derivatives are computed at the first access. The Hessian depends only
    on p.
    """

    value: float
    sloped: Callable[[], np.ndarray]
    curved: Callable[[], np.ndarray]

    @functools.cached_property
    def slope(self) -> np.ndarray:
        return self.sloped()

    @functools.cached_property
    def curvature(self) -> np.ndarray:
        return self.curved()

    def moves(self, length: float) -> np.ndarray:
        """Return changes (n, n) of p, each of one entry, of a length in the Hessian's metric."""
        return np.diag(length / np.sqrt(np.diag(self.curvature)))

    @classmethod
    def impossible(cls, n: int) -> Divergence:
        return cls(np.inf, lambda: np.full(n, np.nan), lambda: np.full((n, n), np.nan))

    @classmethod
    def free(cls, p: np.ndarray, p0: np.ndarray, scale: float) -> Divergence:
        """Compute sum ((p - p0) / scale)^2 / 2, for free parameters."""
        off = (p - p0) / scale
        return cls(float(off @ off) / 2, lambda: off / scale, lambda: np.eye(p.size) / scale**2)

    @classmethod
    def positive(cls, p: np.ndarray, p0: np.ndarray) -> Divergence:
        """Compute sum p / p0 - log(p / p0) - 1, for positive parameters."""
        if not ((p > 0) & (p0 > 0)).all():
            return cls.impossible(p.size)
        excess = _excess((p - p0) / p0)
        return cls(float(excess.sum()), lambda: 1 / p0 - 1 / p, lambda: np.diag(p**-2))

    @classmethod
    def bounded(
        cls, p: np.ndarray, p0: np.ndarray, low: float, high: float, scale: float
    ) -> Divergence:
        """Compute the divergence of bounded parameters, as a sum over the finite bounds."""
        sides = []
        if low > -np.inf:
            sides.append(cls.positive(p - low, p0 - low))
        if high < np.inf:
            sides.append(cls.positive(high - p, high - p0).through(-np.eye(p.size)))
        return functools.reduce(cls.__add__, sides) if sides else cls.free(p, p0, scale)

    @classmethod
    def definite(cls, P: np.ndarray, P0: np.ndarray, along: np.ndarray) -> Divergence:
        """Compute the sum of tr(P0^-1 P) - log det(P0^-1 P) - 4 over matrices P (k, 4, 4).

        Each P is linear in its own n parameters, with the derivatives `along` = dP/dp (n, 4, 4).
        """
        k, n = len(P), len(along)
        flat = along.reshape(n, -1)
        try:
            half = np.linalg.inv(np.linalg.cholesky(P0))
            turn = half.transpose(0, 2, 1)
            off = np.linalg.eigvalsh(half @ (P - P0) @ turn)
        except np.linalg.LinAlgError:
            return cls.impossible(k * n)
        if not off.min() > BORDER - 1:
            return cls.impossible(k * n)

        def sloped() -> np.ndarray:
            found: np.ndarray = (turn @ half - np.linalg.inv(P)).reshape(k, -1) @ flat.T
            return found.ravel()

        def curved() -> np.ndarray:
            turned = np.linalg.inv(P)[:, None] @ along
            rows, columns = (x.reshape(k, n, -1) for x in (turned, turned.swapaxes(2, 3)))
            return _diagonal(list(rows @ columns.transpose(0, 2, 1)))

        return cls(float(_excess(off).sum()), sloped, curved)

    @classmethod
    def joined(cls, parts: Sequence[Divergence]) -> Divergence:
        """Concatenate the divergences of several parameter vectors."""
        return cls(
            sum(part.value for part in parts),
            lambda: np.concatenate([part.slope for part in parts]),
            lambda: _diagonal([part.curvature for part in parts]),
        )

    def through(self, A: np.ndarray) -> Divergence:
        """Apply the chain rule: return the divergence as a function of x, with p = A x + b."""
        return Divergence(self.value, lambda: A.T @ self.slope, lambda: A.T @ self.curvature @ A)

    def __add__(self, other: Divergence) -> Divergence:
        return Divergence(
            self.value + other.value,
            lambda: self.slope + other.slope,
            lambda: self.curvature + other.curvature,
        )


def _excess(x: np.ndarray) -> np.ndarray:
    """Compute x - log(1 + x), with a series for small x, which avoids cancellation."""
    near = np.abs(x) < 1e-3
    y = np.where(near, x, 0.0)  # the series of a large x overflows
    series = y * y * (1 / 2 - y * (1 / 3 - y * (1 / 4 - y / 5)))
    return np.where(near, series, x - np.log1p(x))


def _diagonal(blocks: list[np.ndarray]) -> np.ndarray:
    """Assemble a block-diagonal matrix, ten times faster than scipy's function."""
    ends = np.cumsum([len(block) for block in blocks])
    found = np.zeros((ends[-1], ends[-1]))
    for end, block in zip(ends, blocks, strict=True):
        own = slice(end - len(block), end)
        found[own, own] = block
    return found
