"""Radau's transformation: the eigenvalues of a method, and the stages that they set apart."""

import jax.numpy as jnp
import numpy as np
import pytest

from rbjax.solvers import tableau as tables
from rbjax.solvers.constrained.simplified import Spectrum, spectrum, weight, weights

METHODS = {
    "radau1": tables.radau_iia(1), "radau2": tables.radau_iia(2), "radau3": tables.radau_iia(3),
    "radau5": tables.radau_iia(5), "gauss2": tables.gauss(2), "gauss3": tables.gauss(3),
    "lobatto2": tables.lobatto_iiic(2), "lobatto3": tables.lobatto_iiic(3),
}  # fmt: skip


def diagonal(found: Spectrum) -> np.ndarray:
    """The matrix of eigenvalues."""
    r = len(found.real)
    out = np.diag(np.concatenate([found.real, np.repeat(found.pairs[:, 0], 2)]))
    for k, (_, y) in enumerate(found.pairs):
        i = r + 2 * k
        out[i, i + 1], out[i + 1, i] = -y, y
    return out


@pytest.mark.parametrize("name", METHODS)
def test_eigenvalues(name: str) -> None:
    """A T = T diag, T T^-1 = 1, and trace and determinant of A."""
    a = np.array(METHODS[name].a)
    found = spectrum(a)
    np.testing.assert_allclose(a @ found.to, found.to @ diagonal(found), atol=1e-14)
    np.testing.assert_allclose(found.to @ found.back, np.eye(len(a)), atol=1e-13)
    trace = found.real.sum() + 2 * found.pairs[:, 0].sum()
    product = found.real.prod() * (found.pairs**2).sum(1).prod()
    np.testing.assert_allclose([trace, product], [np.trace(a), np.linalg.det(a)], rtol=1e-12)


def test_radau_of_three_stages() -> None:
    """The roots of 60 x^3 - 36 x^2 + 9 x - 1, the denominator of its stability function turned
    round (Hairer & Wanner, II, IV.8)."""
    found = spectrum(np.array(tables.radau_iia(3).a))
    values = np.array([*found.real, *(found.pairs @ [1, 1j])])
    np.testing.assert_allclose(np.polyval([60, -36, 9, -1], values), 0, atol=1e-14)


def test_one_stage() -> None:
    for found in (weight(jnp.array(0.4)), weights(np.array([[0.4]]), jnp.float64)):
        np.testing.assert_allclose(found.inverse, [[2.5]])
        np.testing.assert_allclose(found.spectrum.real, [0.4])
        assert found.spectrum.pairs.shape == (0, 2)
