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
        if min(np.linalg.eigvalsh(P).min(), np.linalg.eigvalsh(P0).min()) <= 0:
            return cls.impossible(len(along))
        ratio, inverse = np.linalg.solve(P0, P), np.linalg.inv(P)
        value = np.trace(ratio) - np.linalg.slogdet(ratio)[1] - len(P)
        turned = inverse @ along
        slope = np.trace(np.linalg.inv(P0) @ along - turned, axis1=1, axis2=2)
        return cls(float(value), slope, np.einsum("iab,jba->ij", turned, turned))

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
