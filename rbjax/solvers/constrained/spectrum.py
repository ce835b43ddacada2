"""The eigenvalues of a method's matrix A, with which the equations of its stages come apart.

    A T = T diag(r_1, ...,  [ x  -y]
                            [ y   x], ...),      T real
A matrix f(A (x) J) of all stages is then one matrix f(r J) for each real eigenvalue, and one
complex matrix f((x + i y) J) for each pair of complex ones: of the coordinates p, q of a pair,
p + i q is multiplied by x + i y. Radau IIA of three stages has one of each, so a step needs a fifth
of the operations and a third of the memory. (Butcher, *BIT* 16, 1976; Hairer & Wanner, *Solving
Ordinary Differential Equations II*, IV.8.)
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np


class Spectrum(NamedTuple):
    """T (s, s), its inverse, the real eigenvalues (r,) and those with a positive imaginary part
    (c, 2); the columns of T are in this order."""

    to: Any
    back: Any
    real: Any
    pairs: Any


def spectrum(a: np.ndarray) -> Spectrum:
    """Of an invertible matrix with distinct eigenvalues."""
    values, vectors = np.linalg.eig(a)
    size = np.abs(values).max()
    real = [k for k in range(len(a)) if abs(values[k].imag) <= 1e-12 * size]
    above = [k for k in range(len(a)) if k not in real and values[k].imag > 0]
    columns = [vectors[:, k].real for k in real]
    for k in above:  # A (p - i q) = (x + i y) (p - i q)
        columns += [vectors[:, k].real, -vectors[:, k].imag]
    to = np.stack(columns, 1)
    pairs = np.array([(values[k].real, values[k].imag) for k in above]).reshape(-1, 2)
    return Spectrum(to, np.linalg.inv(to), values[real].real, pairs)


class Weights(NamedTuple):
    """A (s, s) of a method, its inverse, and its eigenvalues."""

    a: Any
    inverse: Any
    spectrum: Spectrum


def weights(a: np.ndarray, dtype: Any) -> Weights:
    """Of a method with invertible A."""
    found = Weights(a, np.linalg.inv(a), spectrum(a))
    return jax.tree.map(lambda x: jnp.asarray(x, dtype), found)


def weight(a: jax.Array) -> Weights:
    """Of one stage, whose A is a number."""
    a = a.reshape(1, 1)
    one = jnp.ones_like(a)
    return Weights(a, 1 / a, Spectrum(one, one, a[0], jnp.zeros((0, 2), a.dtype)))
