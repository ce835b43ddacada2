"""The stiffness matrix of a beam, against quadrature of the strains."""

import numpy as np
import pytest

from rbjax.errors import InputError
from rbjax.flexible.strain import elastic_energy, stiffness_matrix, strain_beam
from rbjax.lanes import is_zero

BEAM = strain_beam({"k_x": 1, "k_z": 3, "g_y": 2}, points=8)
RNG = np.random.default_rng(0)


def integrated(C, length: float) -> np.ndarray:
    """Integrate B^T C B with forty points; C is a function of s / L."""
    x, w = np.polynomial.legendre.leggauss(40)
    K = 0.0
    for u, weight in zip(x, w, strict=True):
        B = np.zeros((6, BEAM.coordinates))
        for n, (c, j) in enumerate(BEAM.coefficients):
            B[c, n] = np.polynomial.legendre.Legendre.basis(j)(u)
        K = K + length * weight / 2 * B.T @ C((u + 1) / 2) @ B
    return K


def coupled() -> np.ndarray:
    A = RNG.normal(size=(6, 6))
    return A @ A.T


def test_uniform_section():
    C = coupled()
    K = stiffness_matrix(BEAM, C.tolist(), 1.7)
    assert np.abs(np.array(K) - integrated(lambda x: C, 1.7)).max() < 1e-13
    assert is_zero(K[0][1])  # different degrees are orthogonal


def test_diagonal_section_gives_a_diagonal():
    d = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]
    K = stiffness_matrix(BEAM, d, 2.0)
    assert all(is_zero(K[i][j]) for i in range(9) for j in range(9) if i != j)
    assert np.abs(np.array(K) - integrated(lambda x: np.diag(d), 2.0)).max() < 1e-13


def test_tapered_section():
    A, B = coupled(), coupled()
    at = [(A + x**3 * B).tolist() for x in BEAM.nodes]
    K = stiffness_matrix(BEAM, at, 1.7)
    assert np.abs(np.array(K) - integrated(lambda x: A + x**3 * B, 1.7)).max() < 1e-12


def test_energy():
    K = stiffness_matrix(BEAM, coupled().tolist(), 1.0)
    q = RNG.normal(size=9)
    assert abs(elastic_energy(K, list(q)) - q @ np.array(K) @ q / 2) < 1e-13


def test_wrong_shape():
    with pytest.raises(InputError, match="expected \\(6,\\), \\(6, 6\\)"):
        stiffness_matrix(BEAM, [1.0] * 5, 1.0)


def test_six_diagonals_of_a_tapered_beam_are_no_matrix() -> None:
    """Six Gauss points, the default of degree 2: (6, 6) could be one constant matrix."""
    beam = strain_beam({"k_y": 2, "k_z": 2}, tapered=True)
    assert beam.shape.points == 6
    C = np.arange(1.0, 37.0).reshape(6, 6)
    each = [np.diag(row) for row in C]
    np.testing.assert_allclose(
        np.array(stiffness_matrix(beam, C.tolist(), 2.0), float),
        np.array(stiffness_matrix(beam, [x.tolist() for x in each], 2.0), float),
        rtol=1e-14,
    )
