"""`minimise` on a curve of two numbers."""

import numpy as np
import pytest

from rbjax.sysid.estimators.least_squares import identifiable_step, minimise
from rbjax.sysid.parameters.divergence import Divergence
from rbjax.sysid.simulation.simulation_error import sum_of_squares

T = np.linspace(0.0, 3.0, 200)


class Decay:
    """r = a exp(-b t) less what was measured."""

    def __init__(self, noise):
        self.seen = 2 * np.exp(-0.7 * T) + noise * np.random.default_rng(0).normal(size=T.size)

    def residuals(self, x):
        return x[0] * np.exp(-x[1] * T) - self.seen

    def cost(self, x):
        return sum_of_squares(self.residuals(x))

    def triangle(self, x):
        e = np.exp(-x[1] * T)
        J = np.stack([e, -x[0] * T * e], 1)
        return np.linalg.qr(np.column_stack([J, self.residuals(x)]), mode="r")

    def divergence(self, x, x0):
        return Divergence.positive(x, x0)


@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 1e-12), (0.05, 0.03)])
def test_a_fit_ends(noise, tolerance):
    """With noise too: digits that it hides are not waited for, and the slope there is none."""
    of = Decay(noise)
    least = minimise(of, np.array([0.5, 2.0]), max_evaluations=40)
    assert least.success and least.evaluations < 30
    np.testing.assert_allclose(least.x, [2.0, 0.7], atol=tolerance)
    J, r = least.triangle[:, :2], least.triangle[:, 2]
    if noise:
        assert np.linalg.norm(J @ np.linalg.lstsq(J, r)[0]) < 1e-4 * np.linalg.norm(r)


class Torn(Decay):
    """Slopes that overflow where x[1] is below a half, though residuals do not."""

    refused, there = 0, np.nan

    def triangle(self, x):
        self.refused += x[1] < 0.5
        with np.errstate(invalid="ignore"):  # a zero times infinity
            return super().triangle(x) * (1.0 if x[1] >= 0.5 else self.there)


@pytest.mark.parametrize("there", [np.nan, np.inf, 1e200])
def test_a_point_without_slopes_is_refused(there):
    of = Torn(0.0)
    of.there = there
    least = minimise(of, np.array([3.0, 3.0]), max_evaluations=80)
    assert least.success and of.refused
    np.testing.assert_allclose(least.x, [2.0, 0.7], atol=1e-9)
    never = minimise(Torn(0.0), np.array([2.0, 0.4]))
    assert not never.success and "not finite" in never.status.text


class Wrong(Decay):
    """Slopes with the wrong sign: no step lowers the error."""

    def triangle(self, x):
        R = super().triangle(x)
        R[:, -1] *= -1
        return R


@pytest.mark.parametrize(
    ("of", "start", "steps", "said"),
    [
        (Decay(0.05), [0.5, 2.0], 40, "converged"),
        (Decay(0.0), [2.0, 0.7], 40, "converged"),  # at the minimum, where nothing is left
        (Wrong(0.05), [0.5, 2.0], 40, "stuck"),
        (Wrong(0.0), [2.5, 0.7], 40, "stuck"),
        (Decay(0.05), [0.5, 2.0], 2, "not converged"),
        (Decay(0.05), [0.0, 2.0], 40, "border"),
        (Torn(0.0), [2.0, 0.4], 40, "not finite"),
    ],
)
def test_each_end_of_a_search(of, start, steps, said):
    """`success` is a minimum by the slope, not an end of the steps."""
    least = minimise(of, np.array(start), max_evaluations=steps)
    assert said in least.status.text and least.success == (said == "converged")


def test_a_minimum_at_a_border_is_one():
    """A rate below zero would fit best; positive numbers end near 0, and that has converged."""
    of = Decay(0.0)
    of.seen = 2 * np.exp(0.1 * T)
    least = minimise(of, np.array([1.0, 0.5]), max_evaluations=100)
    assert least.success and 0 < least.x[1] < 1e-3


def test_what_nothing_depends_on_does_not_move():
    """Columns of slopes that are exactly 0, such as those of an initial state that is known: their
    step is exactly 0, not rounding of the decomposition."""
    rng = np.random.default_rng(0)
    for _ in range(20):
        R = np.linalg.qr(rng.normal(size=(12, 6)), mode="r")
        R[:, [1, 2]] = 0.0
        R = np.linalg.qr(R, mode="r")
        L = np.diag(rng.uniform(0.5, 2.0, 5))
        step = identifiable_step(R, L)
        assert (step[[1, 2]] == 0).all() and (step[[0, 3, 4]] != 0).all()
        left = R[:, :-1] @ step + R[:, -1]
        np.testing.assert_allclose(R[:, :-1].T @ left, 0, atol=1e-12)
    assert (identifiable_step(np.zeros((3, 3)), np.eye(2)) == 0).all()
