"""Differences, sums and noise of sensor readings, some columns of which are attitudes.

    minus(x, y) = x - y,  of attitudes log(y* x);      plus(x, d) = x + d,  of attitudes x exp(d)
An attitude has four columns, a quaternion (w, x, y, z). Its difference has three entries in rad, in
body axes. Its noise is the noise of the rotation, computed from the largest of its four columns.

Source: Sola, Deray & Atchuthan, *A micro Lie theory*, 2018, eq. 25, 26.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rbjax.rotations import quaternion


@dataclass(frozen=True)
class Columns:
    """The columns of a reading. size: their number. turns: first column of each attitude."""

    size: int
    turns: tuple[int, ...] = ()

    def minus(self, x: jax.Array, y: jax.Array) -> jax.Array:
        """Compute the difference x (-) y of two readings (n,). A zero quaternion y, which marks a
        missing sample, is replaced by the identity."""
        parts = []
        for at, turns in self._parts():
            a, b = x[at], y[at]
            if turns:
                none = jnp.array([1.0, 0.0, 0.0, 0.0], b.dtype)
                b = jnp.where((b == 0).all(), none, b)
                parts.append(quaternion.log(quaternion.multiply(quaternion.conjugate(b), a)))
            else:
                parts.append(a - b)
        return jnp.concatenate(parts)

    def plus(self, x: jax.Array, d: jax.Array) -> jax.Array:
        """Add a difference d to a reading x (n,): x (+) d."""
        parts, k = [], 0
        for at, turns in self._parts():
            if turns:
                parts.append(quaternion.multiply(x[at], quaternion.exp(d[k : k + 3])))
                k += 3
            else:
                width = at.stop - at.start
                parts.append(x[at] + d[k : k + width])
                k += width
        return jnp.concatenate(parts)

    def weights(self, w: jax.Array) -> jax.Array:
        """Convert weights (..., n) of readings to weights of the entries of `minus`.

        A quaternion has 4 columns, and a difference of 3 entries with the least of their weights.
        """
        if not self.turns:
            return w
        parts = []
        for at, turns in self._parts():
            part = w[..., at]
            shape = (*w.shape[:-1], 3)
            parts.append(jnp.broadcast_to(part.min(-1, keepdims=True), shape) if turns else part)
        return jnp.concatenate(parts, -1)

    def aligned(self, recorded: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """Return recorded (T, n) with the sign of each quaternion nearest to the simulated one."""
        found = recorded.copy()
        for k in self.turns:
            at = slice(k, k + 4)
            other = (found[:, at] * simulated[:, at]).sum(1, keepdims=True) < 0
            found[:, at] = np.where(other, -found[:, at], found[:, at])
        return found

    def residual(self, recorded: np.ndarray, simulated: np.ndarray) -> np.ndarray:
        """Compute simulated minus recorded (T, n), with a factor 2 for quaternions, so that the
        norm of their residual is the angle in rad if it is small."""
        off = simulated - recorded
        for k in self.turns:
            off[:, k : k + 4] *= 2
        return off

    def noise(self, rms: np.ndarray) -> np.ndarray:
        """Compute the standard deviations (n,) of noise for residuals of size rms (n,); for an
        attitude, of the rotation about each axis."""
        found = rms.copy()
        for k in self.turns:
            found[k : k + 4] = np.sqrt((rms[k : k + 4] ** 2).sum() / 3)
        return found

    def _parts(self) -> Iterator[tuple[slice, bool]]:
        """Iterate over the slices of columns; the flag is True for an attitude."""
        at = 0
        for k in self.turns:
            if k > at:
                yield slice(at, k), False
            yield slice(k, k + 4), True
            at = k + 4
        if at < self.size:
            yield slice(at, self.size), False


def root_mean_square(r: Any) -> np.ndarray:
    """Compute the root mean square of each column of (samples, n), ignoring nan entries."""
    there = ~np.isnan(r)
    count = there.sum(0)
    squares = np.where(there, r, 0.0) ** 2
    return np.asarray(np.where(count > 0, np.sqrt(squares.sum(0) / np.maximum(count, 1)), np.nan))
