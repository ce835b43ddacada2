"""Constants of the Legendre basis on a beam, x = s / L in [0, 1].

    P_j(2 x - 1),   int P_i P_j dx = delta_ij / (2 j + 1)

A function that is known at n Gauss points is integrated as its interpolating polynomial:

    int_0^x f = sum_h a_h(x) f(x_h),   a_h(x) = w_h sum_j (2 j + 1) P_j(x_h) int_0^x P_j

All results are NumPy arrays or Python floats, which are compile-time constants.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

#: the shape function of a coordinate: index of the strain -> coefficients of P_j
ShapeFunction = Mapping[int, Sequence[float]]
#: the value of a shape function at a place: index of the strain -> value
ShapeValue = Mapping[int, float]


def gauss_points(n: int) -> tuple[np.ndarray, np.ndarray]:
    """Compute the n Gauss points in [0, 1] and their weights, whose sum is 1.

    >>> gauss_points(1)
    (array([0.5]), array([1.]))
    """
    x, w = np.polynomial.legendre.leggauss(n)
    return (x + 1) / 2, w / 2


def legendre(degree: int, x: float) -> np.ndarray:
    """Compute P_j(2 x - 1), j = 0..degree.

    >>> legendre(2, 1.0).tolist(), legendre(2, 0.5).tolist()
    ([1.0, 1.0, 1.0], [1.0, 0.0, -0.5])
    """
    u, values = 2 * x - 1, [1.0, 2 * x - 1]
    for j in range(1, degree):
        values.append(((2 * j + 1) * u * values[j] - j * values[j - 1]) / (j + 1))
    return np.array(values[: degree + 1])


def product(a: Sequence[float], b: Sequence[float]) -> float:
    """Compute int f g dx of the functions with the coefficients a and b; rounding errors are zero.

    >>> product([1.0, 3.0], [2.0, 0.0, 5.0]), product([0.0, 1.0], [0.0, 1.0]) == 1 / 3
    (2.0, True)
    """

    def inner(a: Sequence[float], b: Sequence[float]) -> float:
        return sum(x * y / (2 * j + 1) for j, (x, y) in enumerate(zip(a, b, strict=False)))

    x = inner(a, b)
    return 0.0 if x * x <= (1e-13) ** 2 * inner(a, a) * inner(b, b) else x


def integrals(degree: int, x: float) -> np.ndarray:
    """Compute int_0^x P_j, j = 0..degree.

    >>> integrals(1, 1.0).tolist()
    [1.0, 0.0]
    """
    P, j = legendre(degree + 1, x), np.arange(1, degree + 1)
    return np.array([x, *((P[2:] - P[:-2]) / (2 * j + 1) / 2)])


def integration_matrix(points: int, ends: np.ndarray) -> np.ndarray:
    """Compute the weights a_h(x) (len(ends), points) of integrals from 0 to each end x.

    >>> np.allclose(integration_matrix(3, np.array([0.5])) @ gauss_points(3)[0], 0.125)
    True
    """
    nodes, w = gauss_points(points)
    P = np.array([legendre(points - 1, x) for x in nodes])
    Q = np.array([integrals(points - 1, x) for x in ends])
    return Q @ ((2 * np.arange(points) + 1) * P).T * w


def cell_moments(degree: int, a: float, b: float) -> np.ndarray:
    """Compute the moments (4, degree + 1) of each P_j over a cell [a, b].

    With u in [-1/2, 1/2] over the cell of length h, the rows are

        B_0 = h int P du,   a_1 = B_0 - a_3 / 12,   a_2 = 12 h int u P du,
        a_3 = 180 h int (u^2 - 1/12) P du

    For P = k + u k' + u^2 k''/2, with derivatives by u at the midpoint, these are a_1 = h k,
    a_2 = h k', a_3 = h k''/2, so that the Magnus expansion in a_1, a_2, a_3 has order 6 (Blanes,
    Casas, Oteo & Ros, 2009, section 5.5).
    """
    nodes, w = gauss_points(degree // 2 + 3)  # exact to degree + 3
    h, u = b - a, nodes - 0.5
    P = np.array([legendre(degree, a + h * x) for x in nodes])
    zeroth = h * (w @ P)
    first = 12 * h * ((w * u) @ P)
    second = 180 * h * ((w * (u * u - 1 / 12)) @ P)
    first[:1] = second[:2] = 0.0  # exact zeros of polynomials of lower degree
    return np.array([zeroth, zeroth - second / 12, first, second])
