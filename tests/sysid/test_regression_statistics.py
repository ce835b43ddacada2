"""Intervals of regressions: coloured residuals, wrong statements of the noise, failures."""

import functools

import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.errors import InputError
from rbjax.sysid.torque import regress, select
from rbjax.sysid.torque.encoder_zeros import regress_with_zeros

NAMES = ["offset", "slope", "wave"]
BETA = np.array([1.0, -2.0, 0.5])


def line(n):
    t = np.linspace(0.0, 1.0, n)
    return np.stack([np.ones(n), t, np.sin(9 * t)], 1)


def correlated(rng, n, rho):
    """Noise of standard deviation 1, each sample rho of the last one."""
    x = rng.normal(size=n + 200)
    for k in range(1, len(x)):
        x[k] = rho * x[k - 1] + np.sqrt(1 - rho**2) * x[k]
    return x[200:]


def coverage(method, noise_of, *, stated=None, n=400, count=150, **options):
    """The share of intervals that hold the truth."""
    W, held = line(n), []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        found = regress(
            W, W @ BETA + noise_of(rng, n), NAMES, method=method, noise=stated, **options
        )
        low, high = found.intervals().T
        held.append((low < BETA) & (high > BETA))
    return float(np.mean(held))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["ordinary", "weighted", "robust"])
def test_intervals_of_coloured_residuals_hold(method):
    """rho = 0.8: intervals for white noise are three times too narrow and hold 49 %. With 400
    samples, of which 44 are independent, the kernel's estimate is a tenth low: 88 to 95 %."""
    rate = coverage(method, lambda rng, n: 0.1 * correlated(rng, n, 0.8))
    assert 0.86 < rate < 0.97, rate


def test_intervals_of_coloured_residuals_hold_in_a_few():
    """30 draws of the above: far from the 49 % of intervals for white noise."""
    rate = coverage("ordinary", lambda rng, n: 0.1 * correlated(rng, n, 0.8), count=30)
    assert rate > 0.8, rate


@pytest.mark.slow
def test_intervals_of_instruments_hold_in_coloured_noise():
    W = line(400)
    rate = coverage(
        "instrumental", lambda rng, n: 0.1 * correlated(rng, n, 0.8), instruments=W[:, None]
    )
    assert 0.86 < rate < 0.97, rate


@pytest.mark.slow
@pytest.mark.parametrize("stated", [None, 0.1, 0.03, 0.5])
def test_intervals_follow_the_residuals_whatever_the_statement(stated):
    """White noise of 0.1, stated right, too small, too large, or not at all: three standard errors
    of 450 correlated figures around 95 %."""
    rate = coverage("weighted", lambda rng, n: 0.1 * rng.normal(size=n), stated=stated)
    assert 0.92 < rate < 0.98, rate


@pytest.mark.parametrize("stated", [None, 0.1, 0.03, 0.5])
def test_standard_errors_follow_the_residuals(stated):
    """Of one draw: those of noise that is stated right, to a tenth."""
    W, noise = line(400), 0.1 * np.random.default_rng(0).normal(size=400)
    found = regress(W, W @ BETA + noise, NAMES, noise=stated)
    want = regress(W, W @ BETA + noise, NAMES, noise=0.1)
    np.testing.assert_allclose(found.errors, want.errors, rtol=0.1)


def test_what_is_white_is_said():
    W, rng = line(300), np.random.default_rng(0)
    white = regress(W, W @ BETA + rng.normal(size=300), NAMES)
    coloured = regress(W, W @ BETA + correlated(rng, 300, 0.9), NAMES)
    assert white.white and white.dof == 297
    assert not coloured.white and coloured.dof < 60
    stated = regress(W, W @ BETA + rng.normal(size=300), NAMES, noise=1.0)
    assert stated.white and stated.dof == np.inf


def test_correlations_end_with_a_recording():
    """Two recordings with a constant error each: one step in 400 samples is no correlation of
    neighbours that belong to different recordings."""
    W, rng = line(60), np.random.default_rng(3)
    noise = correlated(rng, 60, 0.9)
    one = regress(W, W @ BETA + noise, NAMES)
    many = regress(W, W @ BETA + noise, NAMES, lengths=[1] * 60)
    assert not one.white and many.white  # of recordings of one sample nothing is said
    for lengths in ([30, 20], [60.0], [60, 0], [-1, 61]):
        with pytest.raises(InputError, match="lengths is"):
            regress(W, W @ BETA, NAMES, lengths=lengths)


def test_consistent_intervals_follow_coloured_residuals():
    """The same rows with noise that is coloured: wider by what the linear fit is wider."""
    model = rb.load("pendulum")
    rng = np.random.default_rng(0)
    t = np.arange(400) * 0.02
    q, v, a = np.sin(3 * t), 3 * np.cos(3 * t), -9 * np.sin(3 * t)
    W = sysid.torque.regressor(model, q[:, None], v[:, None], a[:, None])
    tau = np.asarray(W @ rb.inertial_parameters(model))
    size = 0.05 * np.abs(tau).max()
    found = {}
    for name, rho in (("white", 0.0), ("coloured", 0.9)):
        noisy = tau + size * correlated(rng, 400, rho)[:, None]
        found[name] = sysid.torque.consistent(model, W, noisy)
        assert found[name].success and found[name].linear.white == (name == "white")
    wide, narrow = (
        np.sqrt(np.diag(found[k].base_covariance)) for k in ("coloured", "white")
    )  # fmt: skip
    assert (wide > 1.5 * narrow).any()
    linear = np.sqrt(np.diag(found["coloured"].linear.covariance))
    np.testing.assert_allclose(wide, linear, rtol=0.2)  # the prior is weak: 100 %


# -- statuses -------------------------------------------------------------------------------------


@pytest.mark.parametrize("loss", ["huber", "bisquare"])
def test_a_robust_regression_says_whether_it_converged(loss):
    W, rng = line(200), np.random.default_rng(1)
    tau = W @ BETA + rng.standard_t(1.5, size=200)
    assert regress(W, tau, NAMES, method="robust", loss=loss).success
    assert not regress(W, tau, NAMES, method="robust", loss=loss, max_steps=1).success


def test_an_instrumental_regression_says_whether_it_converged():
    W, rng = line(200), np.random.default_rng(1)
    seen = W + 0.3 * rng.normal(size=W.shape)
    tau = W @ BETA + 0.1 * rng.normal(size=200)
    how = {"method": "instrumental", "instruments": lambda found: W[:, None] * found.beta[0]}
    assert regress(seen, tau, NAMES, **how).success
    assert not regress(seen, tau, NAMES, max_steps=1, tolerance=1e-12, **how).success


def test_a_consistent_fit_says_whether_it_converged():
    model = rb.load("double_pendulum")
    W = sysid.torque.regressor(model, *sysid.torque.motions.random_motions(model, 50))
    tau = W @ rb.inertial_parameters(model) * 1.5
    assert sysid.torque.consistent(model, W, tau, noise=0.1).success
    assert not sysid.torque.consistent(model, W, tau, noise=0.1, max_steps=2).success


@functools.cache
def rows():
    model, t = rb.load("pendulum"), np.arange(0.0, 4.0, 0.005)
    q, v, a = np.sin(3 * t)[:, None], 3 * np.cos(3 * t)[:, None], -9 * np.sin(3 * t)[:, None]
    tau = np.asarray(sysid.torque.regressor(model, q, v, a) @ rb.inertial_parameters(model))
    channels = {"q": sysid.Channel(t, q - 0.03), "tau": sysid.Channel(t, tau)}
    made = sysid.torque.torque_rows(model, sysid.Recording("swing", channels), 5.0)
    return made.only(["rod.hz", "rod.Iyy"])


def test_a_regression_with_zeros_says_whether_it_converged():
    assert regress_with_zeros([rows()], noise=1e-4).success
    assert not regress_with_zeros([rows()], noise=1e-4, max_steps=1).success


# -- misuse ---------------------------------------------------------------------------------------


def test_selection_with_channels_of_unequal_noise():
    """Two channels, the second a hundred times noisier. Fitted by plain squares, the larger model
    can leave more in the noise's units; by weights it never does, and the F test is one."""
    t = np.linspace(-1, 1, 60)
    powers = np.stack([t**k for k in range(4)], 1)
    earned = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        noise = np.array([0.01, 1.0]) * rng.normal(size=(60, 2))
        W = np.stack([powers, powers], 1)
        tau = (1 + 2 * t)[:, None] + noise
        candidates = {f"degree {n}": (W[..., : n + 1], "abcd"[: n + 1]) for n in range(4)}
        found = select(candidates, tau)  # never "not nested"
        assert found.comparisons[0].significant
        earned += [c.significant for c in found.comparisons[1:]]
        assert abs(found.regression.beta[1] - 2) < 0.02
    assert np.mean(earned) < 0.1  # 1 % is the level of the test


@pytest.mark.parametrize("method", ["weighted", "robust", "instrumental"])
@pytest.mark.parametrize("size", [0.1, 3.0])  # as stated, and 30 times as large
def test_torques_of_infinite_noise_do_not_count(method, size):
    """They are as if they were left out: the same numbers, intervals and degrees of freedom."""
    rng = np.random.default_rng(5)
    W = line(300)[:, None].repeat(2, 1)
    tau = W @ BETA + size * rng.normal(size=(300, 2))
    out = np.arange(300) % 4 == 0
    noise = np.where(out[:, None], np.inf, 0.1) * np.ones((300, 2))
    wild = np.where(out[:, None], 1e3, tau)
    options = {"instruments": W} if method == "instrumental" else {}
    found = regress(W, wild, NAMES, method=method, noise=noise, **options)
    options = {"instruments": W[~out]} if method == "instrumental" else {}
    want = regress(W[~out], tau[~out], NAMES, method=method, noise=0.1, **options)
    np.testing.assert_allclose(found.beta, want.beta, rtol=1e-10)
    np.testing.assert_allclose(found.errors, want.errors, rtol=1e-6)
    np.testing.assert_allclose(found.noise, want.noise, rtol=1e-10)
    assert found.dof == want.dof and found.white == want.white
