"""Dahlquist's two barriers, over families of multistep methods with exact coefficients."""

import itertools
from fractions import Fraction

import numpy as np
import pytest

import rbjax as rb
from rbjax import stability
from rbjax.stability import Characteristic
from rbjax.stability.theory.polynomials import Poly, multiply, poly

ROOTS = [Fraction(x) for x in ("-1", "-1/2", "0", "1/3", "1/2", "9/10", "1", "-3/2", "2")]


def best(rho: Poly, implicit: bool) -> Characteristic:
    """The method of a rho with the highest order: sigma from exact linear equations.

    sum_j a_j j^n / n! = sum_j b_j j^(n-1) / (n-1)!, n = 1, 2, ...
    """
    size = len(rho) if implicit else len(rho) - 1
    rows = [[Fraction(j) ** n for j in range(size)] for n in range(size)]
    right = [
        sum(a * Fraction(j) ** (n + 1) for j, a in enumerate(rho)) / (n + 1) for n in range(size)
    ]
    for i in range(size):  # Gauss and Jordan
        pivot = next(r for r in range(i, size) if rows[r][i])
        rows[i], rows[pivot] = rows[pivot], rows[i]
        right[i], right[pivot] = right[pivot], right[i]
        right[i] /= rows[i][i]
        rows[i] = [x / rows[i][i] for x in rows[i]]
        for r in range(size):
            if r != i:
                factor = rows[r][i]
                rows[r] = [x - factor * y for x, y in zip(rows[r], rows[i], strict=True)]
                right[r] -= factor * right[i]
    return Characteristic((rho, poly(-b for b in right)))


def rhos(k: int) -> list[Poly]:
    """Polynomials with the root 1 and k - 1 others, real ones and pairs."""
    out = []
    for others in itertools.combinations_with_replacement(ROOTS, k - 1):
        rho = poly([-1, 1])
        for root in others:
            rho = multiply(rho, poly([-root, 1]))
        out.append(rho)
    if k == 3:
        out.append(multiply(poly([-1, 1]), poly([1, Fraction(6, 5), 1])))  # on the rim
        out.append(poly([-11, -27, 27, 11]))  # order six, and unstable
    if k == 4:
        out.append(multiply(poly([-1, 0, 1]), poly([1, Fraction(6, 5), 1])))
    return out


@pytest.mark.parametrize("k", [1, 2, 3, pytest.param(4, marks=pytest.mark.slow)])
def test_first_barrier(k: int) -> None:
    """A zero-stable k-step method has order at most k + 1, k + 2 if k is even; explicit ones k."""
    found: dict[bool, set[int]] = {True: set(), False: set()}
    for rho in rhos(k):
        implicit, explicit = best(rho, True), best(rho, False)
        assert implicit.zero_stable == explicit.zero_stable
        found[implicit.zero_stable].add(implicit.order)
        if implicit.zero_stable:
            assert explicit.order <= k
            if implicit.order == k + 2:
                rim = np.abs(np.abs(implicit.spurious_roots) - 1)
                assert rim.max() < 1e-12, "order k + 2 has all roots on the rim"
    barrier = k + 2 if k % 2 == 0 else k + 1
    assert max(found[True]) == barrier
    if k == 3:
        assert max(found[False]) == 6, "only stability forbids more"


def test_second_barrier() -> None:
    """A-stable: order at most 2, and at order 2 the trapezoidal rule has the least constant."""
    for name in rb.solvers.all():
        if name.startswith(("adams", "pece", "bdf")):
            report = stability.linear_analysis(name)
            assert not report.A_stable or report.order <= 2, name
    stable = 0
    # all two-step methods of order two: rho = (zeta - 1)(zeta - a), two free weights
    for a, b2 in itertools.product(
        [Fraction(n, 5) for n in (-4, -1, 0, 2, 4)], [Fraction(n, 4) for n in range(1, 7)]
    ):
        rho = multiply(poly([-1, 1]), poly([-a, 1]))
        first, second = (sum(c * j**n for j, c in enumerate(rho)) / n for n in (1, 2))
        b1 = second - 2 * b2
        phi = Characteristic((rho, poly([-(first - b1 - b2), -b1, -b2])))
        if stability.alpha_degrees(phi) == 90 and phi.zero_stable:
            stable += 1
            assert phi.order == 2
            assert phi.error_constant <= Fraction(-1, 12), (a, b2)
    assert stable > 10
    for rho in rhos(3):  # and none of order three or more
        phi = best(rho, True)
        assert phi.order > 2
        assert not phi.zero_stable or stability.alpha_degrees(phi) < 90
