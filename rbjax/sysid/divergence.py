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
import scipy.linalg


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
        ratio = p / p0
        return cls(float((ratio - np.log(ratio) - 1).sum()), 1 / p0 - 1 / p, np.diag(p**-2))

    @classmethod
    def definite(cls, P: np.ndarray, P0: np.ndarray, along: np.ndarray) -> Divergence:
        """tr(P0^-1 P) - log det(P0^-1 P) - 4, of P linear in p, along = dP/dp (n, 4, 4)."""
        try:
            L, L0 = np.linalg.cholesky(P), np.linalg.cholesky(P0)
        except np.linalg.LinAlgError:
            return cls.impossible(len(along))
        inverse, inverse0 = np.linalg.inv(P), np.linalg.inv(P0)
        value = (inverse0 * P).sum() + 2 * np.log(L0.diagonal() / L.diagonal()).sum() - len(P)
        turned = inverse @ along
        slope = np.tensordot(along, inverse0 - inverse, 2)
        rows, columns = (x.reshape(len(along), -1) for x in (turned, turned.transpose(0, 2, 1)))
        return cls(float(value), slope, rows @ columns.T)

    @classmethod
    def joined(cls, parts: Sequence[Divergence]) -> Divergence:
        """That of several vectors, one after the other."""
        return cls(
            sum(part.value for part in parts), np.concatenate([part.slope for part in parts]),
            scipy.linalg.block_diag(*(part.curvature for part in parts)),
        )  # fmt: skip

    def through(self, A: np.ndarray) -> Divergence:
        """That of x, where p = A x + b."""
        return Divergence(self.value, A.T @ self.slope, A.T @ self.curvature @ A)

    def __add__(self, other: Divergence) -> Divergence:
        slope, curvature = self.slope + other.slope, self.curvature + other.curvature
        return Divergence(self.value + other.value, slope, curvature)
