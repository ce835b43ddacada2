"""The steady Kalman gain: the regulator of the transposed system, (A', C', W, V) for (A, B, Q, R).

Filters and smoothers of a model are in `rbjax.estimation`.

Source: Bryson & Ho, *Applied Optimal Control*, 12; Anderson & Moore, *Optimal Filtering*, 4.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_solve

from rbjax.arguments import flag
from rbjax.control.linear.algebraic_riccati import riccati
from rbjax.control.linear.arguments import check_matrices, weight_matrix
from rbjax.control.linear.riccati import definite_factor
from rbjax.control.products import product
from rbjax.control.status import LinearStatus


class SteadyFilter(NamedTuple):
    """Fields: gain (n, l); P (n, n), the covariance of the error, in discrete time before a sample;
    residual (), error () and status, as in `Regulator`."""

    gain: jax.Array
    P: jax.Array
    residual: jax.Array
    error: jax.Array
    status: Any

    @property
    def success(self) -> jax.Array:
        """Whether there is a solution."""
        return self.status == LinearStatus.success


def kalman_gain(A: Any, C: Any, W: Any, V: Any, *, discrete: bool = False) -> SteadyFilter:
    """The gain L of the steady filter of dx/dt = A x + w, y = C x + e.

        continuous  dx/dt = A x + B u + L (y - C x),    L = P C' V^-1
        discrete    x <- x + L (y - C x), then x+ = A x + B u,   L = P C' (C P C' + V)^-1

    Args:
        A: (n, n). C: (l, n).
        W: the intensity (discrete: the covariance) of w, (n, n) or (n,).
        V: of e, (l, l) or (l,), positive definite.
        discrete: which of the two.

    Returns:
        `SteadyFilter`. `not_stabilisable` means here that (A, C) cannot be observed well enough.

    Raises:
        InputError: shapes, values that are not finite.

    Differentiable in both modes.

    Source: Kalman & Bucy 1961; Anderson & Moore, *Optimal Filtering*, 4.4.

    Example:
        >>> from rbjax.control.linear import kalman_gain
        >>> found = kalman_gain([[0.0, 1.0], [0.0, 0.0]], [[1.0, 0.0]], [0.0, 4.0], [1.0])
        >>> [round(float(x), 6) for x in found.gain[:, 0]]  # sqrt 2 w and w^2, w^2 = 2
        [2.0, 2.0]
    """
    A, C = check_matrices("kalman_gain", ("A", A, "nn"), ("C", C, "ln"))
    discrete = flag("kalman_gain", "discrete", discrete)
    W = weight_matrix("kalman_gain", "W", W, A.shape[0])
    V = weight_matrix("kalman_gain", "V", V, C.shape[0])
    dtype = jnp.result_type(A, C, W, V)
    A, C, W, V = (x.astype(dtype) for x in (A, C, W, V))
    found = riccati(A.T, C.T, W, V, jnp.zeros_like(C.T), discrete)
    gain = found.K.T
    if discrete:
        S = product(C, product(found.P, C.T)) + V
        L, ok = definite_factor((S + S.T) / 2)
        gain = jnp.where(ok, cho_solve((L, True), product(C, found.P)).T, 0.0)
    return SteadyFilter(gain, found.P, found.residual, found.error, found.status)
