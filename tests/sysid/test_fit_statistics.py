"""Covariance and intervals of linear fits whose truth is known: the one path of all estimators."""

import numpy as np
import pytest

from rbjax.sysid.simulation.simulation_error import HUBER
from rbjax.sysid.statistics.fit_statistics import FitColumn, FitRows, _scores, fit_statistics

M = 300
T = np.linspace(0.0, 3.0, M)
J = np.stack([np.ones(M), T, np.sin(5 * T)], 1)
TRUTH = np.array([1.0, -2.0, 0.5])
NAMES = ["a", "b", "c"]


def columns(residual, slopes=J, huber=False, stated=True):
    inside = np.abs(residual) < HUBER if huber else np.ones(len(residual), bool)
    psi = np.where(inside, residual, HUBER * np.sign(residual))
    rows = FitRows(slopes, psi, inside, np.arange(len(psi)), np.arange(slopes.shape[1]))
    return [FitColumn("y[0]", [rows], stated)]


def coverage(noise, huber=False, repetitions=150, stated=True):
    """The share of 95 % intervals that hold the truth, of fits weighed by 1 / 1."""
    rng = np.random.default_rng(0)
    held, said = [], None
    for _ in range(repetitions):
        y = J @ TRUTH + noise(rng)
        x = np.linalg.lstsq(J, y)[0]
        for _ in range(50 if huber else 0):  # iteratively reweighted
            r = J @ x - y
            w = np.sqrt(np.minimum(1.0, HUBER / np.maximum(np.abs(r), 1e-9)))
            x = np.linalg.lstsq(J * w[:, None], y * w)[0]
        said = fit_statistics(NAMES, x, columns(J @ x - y, huber=huber, stated=stated))
        spans = [said.estimates.interval(name) for name in NAMES]
        held.append([s.low <= v <= s.high for s, v in zip(spans, TRUTH, strict=True)])
    return float(np.mean(held)), said


def coloured(rng, rho=0.8):
    e = rng.normal(size=M + 50)
    for k in range(1, len(e)):
        e[k] += rho * e[k - 1]
    return e[50:]


def outliers(rng):
    return rng.normal(size=M) + (rng.random(M) < 0.05) * rng.normal(size=M) * 20


@pytest.mark.parametrize("size", [1.0, 0.01, 30.0])
@pytest.mark.parametrize("stated", [True, False])
def test_intervals_follow_the_residuals_whatever_noise_is_stated(size, stated):
    """The noise that rows are weighed by may be wrong by 100 either way."""
    share, said = coverage(lambda rng: size * rng.normal(size=M), stated=stated)
    assert 0.92 < share < 0.985  # 450 intervals: 3 standard deviations are 0.031
    assert abs(said.scale["y[0]"] / size - 1) < 0.15 and said.rows == M


def test_outliers_with_huber():
    share, said = coverage(outliers, huber=True)
    assert 0.92 < share < 0.985
    clean = fit_statistics(NAMES, TRUTH, columns(np.random.default_rng(1).normal(size=M)))
    ratio = said.estimates.sigma / clean.estimates.sigma
    assert (ratio > 0.9).all() and (ratio < 1.35).all()  # not the size of the outliers


def test_coloured_residuals_have_the_sandwich():
    """White formulas claim 2 to 3 times less; 300 samples with a memory of 5 are few."""
    share, said = coverage(coloured)
    assert not said.white and said.coloured == ("y[0]",) and said.effective < 0.5
    assert 0.91 < share < 0.98
    white = np.linalg.inv(J.T @ J) * said.scale["y[0]"] ** 2
    assert (np.sqrt(np.diag(said.estimates.covariance)) > 1.4 * np.sqrt(np.diag(white)))[:2].all()


@pytest.mark.slow
@pytest.mark.parametrize("rho", [0.5, 0.8, 0.9, 0.95])
@pytest.mark.parametrize("together", [False, True])
def test_intervals_of_slow_noise_hold(rho, together):
    """95 % of the intervals of 200 draws, each with 300 samples of two columns, whose noise is the
    same or not; 600 intervals, of which those of a draw are not independent: 1.5 % is a standard
    deviation. Of 300 samples with rho = 0.95 eight are independent."""
    held = []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        slow = coloured(rng, rho)
        noise = [slow, slow if together else coloured(rng, rho)]
        slopes = [J, J * [1.0, -1.0, 0.5]]
        y = np.concatenate([G @ TRUTH + e for G, e in zip(slopes, noise, strict=True)])
        whole = np.concatenate(slopes)
        x = np.linalg.lstsq(whole, y)[0]
        r = (whole @ x - y).reshape(2, M)
        each = [
            FitColumn(f"y[{c}]", columns(r[c], slopes[c])[0].runs, True) for c in range(2)
        ]  # fmt: skip
        said = fit_statistics(NAMES, x, each)
        spans = [said.estimates.interval(name) for name in NAMES]
        held.append([s.low <= v <= s.high for s, v in zip(spans, TRUTH, strict=True)])
    assert 0.90 < np.mean(held) < 0.99


def test_innovations_count_with_all_that_follows():
    """The scores of any rho have one sum, that of J^T psi; gaps and clocks do not matter."""
    rng = np.random.default_rng(0)
    for rho in (-0.9, 0.0, 0.5, 0.985):
        sums = []
        for place in (np.arange(40), np.sort(rng.choice(400, 40, replace=False))):
            G, psi = rng.normal(size=(40, 3)), rng.normal(size=40)
            rows = FitRows(G, psi, np.ones(40, bool), place, np.arange(3))
            none = FitRows(G[:0], psi[:0], np.ones(0, bool), place[:0], np.arange(3))
            both = [
                FitColumn("a", [rows, none], True),
                FitColumn("b", [none, rows], True),
            ]
            turned = [[G, G[:0]], [G[:0], G]]
            sums.append(sum(g.sum(0) for g in _scores(both, turned, np.array([rho, 0.3]))))
            np.testing.assert_allclose(sums[-1], 2 * G.T @ psi, atol=1e-9)


def test_columns_of_unequal_noise_and_few_samples():
    """A column of one sample that its own number fits says nothing of the noise; the stated
    noise stands, or that of all."""
    rng = np.random.default_rng(3)
    wide = np.pad(J, ((0, 0), (0, 1)))
    single = np.array([[0.0, 0.0, 0.0, 1.0]])
    first = columns(0.1 * rng.normal(size=M), wide)[0]
    for stated, sigma in ((True, 1.0), (False, 0.1)):
        rows = FitRows(single, np.zeros(1), np.ones(1, bool), np.zeros(1, int), np.arange(4))
        said = fit_statistics(
            [*NAMES, "d"], np.zeros(4), [first, FitColumn("z[0]", [rows], stated)]
        )
        assert abs(said.estimates.interval("d").sigma / sigma - 1) < 0.15


def test_what_no_row_shows_is_infinite():
    wide = np.column_stack([J, np.zeros(M)])
    said = fit_statistics([*NAMES, "d"], np.zeros(4), columns(np.ones(M), wide))
    assert np.isinf(said.estimates.interval("d").sigma)
    assert np.isfinite(said.estimates.sigma[:3]).all()


def test_runs_with_numbers_of_their_own():
    """Two runs with an offset each: the covariance is that of the joined problem."""
    rng = np.random.default_rng(4)
    r = [rng.normal(size=M), rng.normal(size=M)]
    own = [np.array([0, 1, 2]), np.array([0, 1, 3])]
    slopes = np.stack([T, np.sin(5 * T), np.ones(M)], 1)
    rows = [FitRows(slopes, r[k], np.ones(M, bool), np.arange(M), own[k]) for k in (0, 1)]
    said = fit_statistics(["b", "c", "a0", "a1"], np.zeros(4), [FitColumn("y[0]", rows, True)])
    whole = np.zeros((2 * M, 4))
    for k in (0, 1):
        whole[k * M : (k + 1) * M, own[k]] = slopes
    s2 = np.sum(np.square(r)) / (2 * M - 4)
    want = np.linalg.inv(whole.T @ whole) * s2
    np.testing.assert_allclose(said.estimates.covariance, want, rtol=1e-9)


def test_a_basis_stands_for_the_expanded_derivatives():
    """The same covariance from derivatives along two directions as from those by three unknowns,
    also with a known factor, for coloured and for clipped residuals."""
    rng = np.random.default_rng(3)
    bases = [rng.normal(size=(2, 3)) for _ in range(2)]
    slopes = [rng.normal(size=(M, 2)) for _ in range(2)]
    which, x = np.arange(3), np.zeros(3)
    for noise, huber in [(coloured, False), (outliers, True), (lambda r: r.normal(size=M), False)]:
        said = []
        r = [noise(rng) for _ in range(2)]
        for whole in (True, False):
            made = []
            for c in range(2):
                [column] = columns(r[c], slopes[c] @ bases[c] if whole else slopes[c], huber)
                rows = column.runs[0]._replace(which=which)
                rows = rows if whole else rows._replace(basis=bases[c])
                made.append(FitColumn(f"y[{c}]", [rows], True))
            said.append(fit_statistics(NAMES, x, made))
        J = np.concatenate([s @ b for s, b in zip(slopes, bases, strict=True)])
        said.append(fit_statistics(NAMES, x, made, factor=np.linalg.qr(J, mode="r")))
        assert said[0].white != (noise is coloured)
        for other in said[1:]:
            np.testing.assert_allclose(
                other.estimates.covariance, said[0].estimates.covariance, rtol=1e-9
            )
            assert other.estimates.dof == pytest.approx(said[0].estimates.dof)
