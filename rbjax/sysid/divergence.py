"""Divergences: how far numbers are from a guess, where what is impossible is infinitely far.

D(p, p0) is convex in p and the Bregman divergence of -log det, of numbers and of matrices:

    positive    sum p / p0 - log(p / p0) - 1
    inertia     tr(P0^-1 P) - log det(P0^-1 P) - 4,   P the pseudo-inertia
    free        sum ((p - p0) / scale)^2 / 2

Source: Lee, Wensing & Park, *Geometric robot dynamic identification*, IEEE T-RO 36(2), 2020.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

#: a body thinner than this, beside the guess, counts as impossible: rounding would make it so
BORDER = 1e-7


@dataclass(frozen=True)
class Divergence:
    """D >= 0, infinite where p is impossible; its slope (n,) and its curvature (n, n)."""

    value: float
    slope: np.ndarray
    curvature: np.ndarray

    @classmethod
    def impossible(cls, n: int) -> Divergence:
        return cls(np.inf, np.full(n, np.nan), np.full((n, n), np.nan))

    @classmethod
    def free(cls, p: np.ndarray, p0: np.ndarray, scale: float) -> Divergence:
        """sum ((p - p0) / scale)^2 / 2"""
        off = (p - p0) / scale
        return cls(float(off @ off) / 2, off / scale, np.eye(p.size) / scale**2)

    @classmethod
    def positive(cls, p: np.ndarray, p0: np.ndarray) -> Divergence:
        """sum p / p0 - log(p / p0) - 1"""
        if not ((p > 0) & (p0 > 0)).all():
            return cls.impossible(p.size)
        return cls(_excess((p - p0) / p0), 1 / p0 - 1 / p, np.diag(p**-2))

    @classmethod
    def definite(cls, P: np.ndarray, P0: np.ndarray, along: np.ndarray) -> list[Divergence]:
        """tr(P0^-1 P) - log det(P0^-1 P) - 4, of P linear in p, along = dP/dp (n, 4, 4), for each
        of several P (k, 4, 4)."""
        n = len(along)
        try:
            half, inverse = np.linalg.inv(np.linalg.cholesky(P0)), np.linalg.inv(P)
        except np.linalg.LinAlgError:
            return [cls.impossible(n)] * len(P)
        turn = half.transpose(0, 2, 1)
        off = np.linalg.eigvalsh(half @ (P - P0) @ turn)
        flat = along.reshape(n, -1)
        slopes = (turn @ half - inverse).reshape(len(P), -1) @ flat.T
        turned = inverse[:, None] @ along
        rows, columns = (x.reshape(len(P), n, -1) for x in (turned, turned.swapaxes(2, 3)))
        curved = rows @ columns.transpose(0, 2, 1)
        return [
            cls(_excess(e), g, H) if e[0] > BORDER - 1 else cls.impossible(n)
            for e, g, H in zip(off, slopes, curved, strict=True)
        ]

    @classmethod
    def joined(cls, parts: Sequence[Divergence]) -> Divergence:
        """That of several vectors, one after the other."""
        ends = np.cumsum([part.slope.size for part in parts])
        curved = np.zeros((ends[-1], ends[-1]))
        for end, part in zip(ends, parts, strict=True):
            own = slice(end - part.slope.size, end)
            curved[own, own] = part.curvature
        slope = np.concatenate([part.slope for part in parts])
        return cls(sum(part.value for part in parts), slope, curved)

    def through(self, A: np.ndarray) -> Divergence:
        """That of x, where p = A x + b."""
        return Divergence(self.value, A.T @ self.slope, A.T @ self.curvature @ A)

    def __add__(self, other: Divergence) -> Divergence:
        slope, curvature = self.slope + other.slope, self.curvature + other.curvature
        return Divergence(self.value + other.value, slope, curvature)


def _excess(x: np.ndarray) -> float:
    """sum x - log(1 + x), which is x^2 / 2 where x is small, without cancellation."""
    series = x * x * (1 / 2 - x * (1 / 3 - x * (1 / 4 - x / 5)))
    return float(np.where(np.abs(x) < 1e-3, series, x - np.log1p(x)).sum())
