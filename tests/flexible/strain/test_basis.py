"""Constants of the Legendre basis, against numpy's polynomials."""

import numpy as np
import pytest
from numpy.polynomial import Legendre, Polynomial

from rbjax.flexible.strain import basis


def shifted(j: int) -> Polynomial:
    return Legendre.basis(j, domain=[0, 1]).convert(kind=Polynomial)


@pytest.mark.parametrize("degree", [0, 1, 5])
def test_values_integrals_and_moments(degree):
    a, b = 0.2, 0.45
    u = Polynomial([-(a + b) / 2, 1.0]) / (b - a)
    for j in range(degree + 1):
        P = shifted(j)
        of = lambda f, lo=a, hi=b: f.integ()(hi) - f.integ()(lo)  # noqa: E731
        B0, B1, B2 = (of(u**k * P) for k in range(3))
        assert abs(basis.legendre(degree, a)[j] - P(a)) < 1e-13
        assert abs(basis.integrals(degree, a)[j] - of(P, 0.0, a)) < 1e-13
        moments = [B0, 9 / 4 * B0 - 15 * B2, 12 * B1, 180 * (B2 - B0 / 12)]
        assert np.abs(basis.cell_moments(degree, a, b)[:, j] - moments).max() < 1e-11


def test_integration_matrix_is_exact_for_polynomials():
    """Degree n - 1 at any end, and 2 n - 1 at the tip."""
    n, ends = 6, np.array([0.0, 0.3, 0.81, 1.0])
    x, w = basis.gauss_points(n)
    A = basis.integration_matrix(n, ends)
    for k in range(n):
        assert np.abs(A @ x**k - ends ** (k + 1) / (k + 1)).max() < 1e-15
    assert abs(w @ x ** (2 * n - 1) - 1 / (2 * n)) < 1e-15
    assert np.abs(A[-1] - w).max() < 1e-15
