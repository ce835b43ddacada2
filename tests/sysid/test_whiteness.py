"""Ljung-Box by hand and by its distribution; the sandwich where ordinary intervals fail."""

import numpy as np
import pytest
from scipy import signal, stats

from rbjax.sysid.statistics import whiteness
from rbjax.sysid.statistics.residual_tests import long_run_covariance


def sandwich(X, r, lag=None):
    """The covariance of a fit, whose bread is X^T X; of one recording or of several."""
    Xs, rs = (X, r) if isinstance(X, list) else ([X], [r])
    n, rows = Xs[0].shape[-1], sum(r.size for r in rs)
    bread = np.linalg.inv(sum(x.reshape(-1, n).T @ x.reshape(-1, n) for x in Xs))
    scores = [(x * e[..., None]).reshape(len(x), -1, n).sum(1) for x, e in zip(Xs, rs, strict=True)]
    return bread @ long_run_covariance(scores, lag) @ bread * (rows / (rows - n))


def first_order(rng, rho, size, axis=-1):
    """A stationary first-order process of variance 1."""
    e = rng.normal(size=size) * np.sqrt(1 - rho**2)
    e[..., 0] /= np.sqrt(1 - rho**2)
    return signal.lfilter([1], [1, -rho], e, axis=axis)


def test_statistic_by_hand():
    """1, -1, 1, ... of 10: rho_1 = -9/10, rho_2 = 8/10."""
    r = np.array([1.0, -1.0] * 5)
    found = whiteness(r, lags=2)
    np.testing.assert_allclose(found.correlation, [-0.9, 0.8], rtol=1e-13)
    Q = 10 * 12 * (0.81 / 9 + 0.64 / 8)
    assert abs(found.statistic / Q - 1) < 1e-13
    assert abs(found.p_value / np.exp(-Q / 2) - 1) < 1e-12  # chi-squared with 2 is exponential
    assert not found.white and "not white" in found.summary()


def test_white_noise_passes_as_often_as_said():
    rng = np.random.default_rng(0)
    p = [whiteness(rng.normal(size=400)).p_value for _ in range(300)]
    assert stats.kstest(p, "uniform").pvalue > 0.01
    assert whiteness(first_order(rng, 0.5, 400)).p_value < 1e-6


@pytest.mark.parametrize("rho", [0.0, 0.8, 0.95])
def test_effective_samples(rho):
    """n (1 - rho) / (1 + rho) for a first-order process, within 15 % from 100,000 samples."""
    r = first_order(np.random.default_rng(1), rho, 100_000)
    assert abs(whiteness(r).effective_samples / (1e5 * (1 - rho) / (1 + rho)) - 1) < 0.15


def test_sandwich_by_hand():
    """Lag 0: White's (X^T X)^-1 X^T diag(r^2) X (X^T X)^-1; lag 1 adds half the neighbours."""
    rng = np.random.default_rng(2)
    X, r = rng.normal(size=(30, 3)), rng.normal(size=30)
    B = np.linalg.inv(X.T @ X) * np.sqrt(30 / 27)
    S = X * r[:, None]
    np.testing.assert_allclose(sandwich(X, r, lag=0), B @ S.T @ S @ B, rtol=1e-10)
    near = S[1:].T @ S[:-1]
    meat = S.T @ S + 0.5 * (near + near.T)
    np.testing.assert_allclose(sandwich(X, r, lag=1), B @ meat @ B, rtol=1e-9)
    # two recordings: no product across; two channels: their scores add up
    near = near - np.outer(S[10], S[9])
    meat = S.T @ S + 0.5 * (near + near.T)
    two = sandwich([X[:10], X[10:]], [r[:10], r[10:]], lag=1)
    np.testing.assert_allclose(two, B @ meat @ B, rtol=1e-9)
    S2 = S[:15] + S[15:]
    pair = sandwich(np.stack([X[:15], X[15:]], 1), np.stack([r[:15], r[15:]], 1), lag=0)
    np.testing.assert_allclose(pair, B @ S2.T @ S2 @ B, rtol=1e-9)


def coverage(rho, experiments, samples=2000):
    rng = np.random.default_rng(3)
    t = np.arange(samples) / samples
    X = np.stack([t**0, t, np.sin(20 * t)], 1)
    H = np.linalg.inv(X.T @ X)
    inside = np.zeros((2, 3))
    for noise in first_order(rng, rho, (experiments, samples)):
        p = H @ X.T @ noise  # the truth is 0
        r = noise - X @ p
        ordinary = H * (r @ r) / (samples - 3)
        for k, cov in enumerate((ordinary, sandwich(X, r))):
            inside[k] += np.abs(p) < 1.96 * np.sqrt(np.diag(cov))
    return inside / experiments


def test_intervals_of_correlated_residuals():
    """rho = 0.9: ordinary intervals are too narrow by sqrt(19) and hold in a third of cases; the
    sandwich's, with a window that makes it a little small, in about 92 %."""
    ordinary, robust = coverage(0.9, 150)
    assert ordinary.max() < 0.5
    assert robust.min() > 0.85


@pytest.mark.slow
def test_coverage_of_the_sandwich():
    """White residuals: as said. Correlated ones: within 4 % of it."""
    white = coverage(0.0, 500)[1]
    assert ((white >= 0.93) & (white <= 0.97)).all(), white
    correlated = coverage(0.9, 500, samples=10_000)[1]
    assert ((correlated >= 0.91) & (correlated <= 0.97)).all(), correlated
