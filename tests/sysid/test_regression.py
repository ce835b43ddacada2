"""Regression against exact fractions, and against truths of simulated measurements."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.errors import InputError, UnknownName
from rbjax.sysid.torque.regression import weighted
from tests.oracles import load
from tests.sysid.arms import fourier, planar_2R

ORACLE = load("identification")
LINE = ORACLE["crlb"]["linear"]
ARM = ORACLE["fourier_excitation"]
NOISE = np.array([0.1, 0.05])  # N m, of the oracle's bound


@functools.cache
def experiment(n=1000):
    """Names, W, exact torques and base parameters of the 2R arm on the oracle's excitation."""
    model = planar_2R(ARM)
    q, v, a = fourier(ARM, np.arange(n) * ARM["T"] / n)
    W = np.asarray(sysid.torque.regressor(model, q, v, a))
    names, pi = sysid.torque.parameter_names(model), np.asarray(rb.inertial_parameters(model))
    base = sysid.statistics.combinations(W, names)
    return names, W, W @ pi, base, base.combine(pi)


def test_a_weighted_line_in_exact_fractions():
    X, sd, y = np.array(LINE["X"], float), np.sqrt(LINE["S"])[:, None], np.array(LINE["y"])[:, None]
    found = sysid.torque.regress(X, y, ["offset", "slope"], noise=sd)
    np.testing.assert_allclose(found.beta, [484 / 509, 1032 / 509], rtol=1e-14)
    want = np.array([[324, -100], [-100, 56]]) / 509
    np.testing.assert_allclose(found.covariance, want, rtol=1e-13)
    np.testing.assert_allclose(((found.residual / sd) ** 2).sum(), 251 / 509, rtol=1e-13)
    half = (found.intervals()[:, 1] - found.intervals()[:, 0]) / 2
    np.testing.assert_allclose(half, LINE["normal_975"] * np.sqrt(np.diag(want)), rtol=1e-12)
    plain = sysid.torque.regress(X, y, ["offset", "slope"], method="ordinary", noise=sd)
    np.testing.assert_allclose(plain.beta, [4 / 5, 21 / 10], rtol=1e-14)
    want = [[18 / 25, -1 / 5], [-1 / 5, 13 / 100]]
    np.testing.assert_allclose(plain.covariance, want, rtol=1e-13)
    unknown = sysid.torque.regress(X, y, ["offset", "slope"], method="ordinary")
    assert unknown.dof == 3
    half = (unknown.intervals()[:, 1] - unknown.beta) / unknown.errors
    np.testing.assert_allclose(half, LINE["student_t_975_3_degrees"], rtol=1e-12)


def test_the_bound_of_the_oracle():
    """Covariance of the six base parameters with the noise known."""
    names, W, tau, base, _ = experiment()
    found = sysid.torque.regress(W, tau, names, noise=NOISE)
    order = ["link1.Izz", "link2.Izz", "link2.hx", "link2.hy", "link1.hx", "link1.hy"]
    at = [[base.names[k] for k in base.kept].index(x) for x in order]
    want = ARM["crlb"]
    np.testing.assert_allclose(found.errors[at], want["sigma_of_p"], rtol=1e-11)
    np.testing.assert_allclose(found.covariance[np.ix_(at, at)], want["covariance"], rtol=1e-9)
    np.testing.assert_allclose(found.beta[at], ARM["truth"]["p"], rtol=1e-11)


@pytest.mark.parametrize("method", ["ordinary", "weighted", "robust", "instrumental"])
def test_without_noise_the_truth_comes_back(method):
    names, W, tau, _, beta = experiment(100)
    options = {"instruments": W} if method == "instrumental" else {}
    found = sysid.torque.regress(W, tau, names, method=method, **options)
    assert found.success
    np.testing.assert_allclose(found.beta, beta, rtol=1e-9)
    assert np.abs(found.residual).max() < 1e-10 and found.noise.max() < 1e-10
    whole = found.parameters(rb.inertial_parameters(planar_2R(ARM)) * 1.2)
    np.testing.assert_allclose(W @ whole, tau, atol=1e-10)
    assert found.summary().count(" to ") == 6


@pytest.mark.parametrize(
    "method", ["ordinary", "weighted", pytest.param("robust", marks=pytest.mark.slow)]
)
def test_intervals_hold(method):
    """95 % of the intervals of 200 experiments, each channel with noise of its own."""
    names, W, tau, base, beta = experiment(60)
    rng = np.random.default_rng(3)
    noise = NOISE if method != "ordinary" else np.array([0.1, 0.1])
    inside = []
    for _ in range(200):
        seen = tau + noise * rng.normal(size=tau.shape)
        low, up = sysid.torque.regress(W, seen, names, method=method, base=base).intervals().T
        inside.append((low < beta) & (beta < up))
    rate = np.mean(inside)
    # six correlated figures of 200 experiments: standard deviation below 0.0154 = sqrt(.05 .95/200)
    assert 0.92 < rate < 0.98, rate


def test_channels_have_noise_of_their_own():
    names, W, tau, base, beta = experiment()
    seen = tau + np.array([3.0, 0.01]) * np.random.default_rng(1).normal(size=tau.shape)
    plain = sysid.torque.regress(W, seen, names, method="ordinary", base=base)
    found = sysid.torque.regress(W, seen, names, base=base)
    np.testing.assert_allclose(found.noise, [3.0, 0.01], rtol=0.1)
    k = [base.names[j] for j in base.kept].index("link2.hx")
    assert abs(found.beta[k] - beta[k]) < 0.1 * abs(plain.beta[k] - beta[k])


def test_noise_of_many_decades():
    """Weights too different for normal equations: exact rows decide what they show."""
    rng = np.random.default_rng(0)
    W, beta = rng.normal(size=(50, 2, 4)), np.array([1.0, -2.0, 0.5, 3.0])
    W[:, 1, 2:] = 0.0  # the second channel shows a and b only
    noise = np.array([1.0, 1e-7])
    tau = W @ beta + noise * rng.normal(size=(50, 2))
    found = sysid.torque.regress(W, tau, "abcd", noise=noise)
    np.testing.assert_allclose(found.beta[:2], beta[:2], atol=1e-6)
    assert (found.errors[:2] < 1e-7).all() and (found.errors[2:] > 0.05).all()
    rest = np.linalg.lstsq(W[:, 0, 2:], tau[:, 0] - W[:, 0, :2] @ found.beta[:2], rcond=None)[0]
    np.testing.assert_allclose(found.beta[2:], rest, rtol=1e-6)
    free = found.noise  # each channel's own degrees of freedom: 50 - 2
    np.testing.assert_allclose(free, noise, rtol=0.35)


@pytest.mark.parametrize("loss", ["huber", "bisquare"])
def test_outliers(loss):
    """5 % of the samples off by 20 N m, one-sided: named, and survived."""
    names, W, tau, base, beta = experiment()
    rng = np.random.default_rng(2)
    seen = tau + NOISE * rng.normal(size=tau.shape)
    wild = rng.uniform(size=tau.shape) < 0.05
    seen = seen + 20.0 * wild
    plain = sysid.torque.regress(W, seen, names, base=base)
    found = sysid.torque.regress(W, seen, names, method="robust", base=base, loss=loss)
    assert found.success
    off, off_robust = (np.abs(x.beta - beta) / found.errors for x in (plain, found))
    assert off.max() > 100
    # Huber's bound of a one-sided pull leaves a bias: 5 % of 1.345 sd; bisquare leaves none
    assert off_robust.max() < (8 if loss == "huber" else 4)
    assert (found.weights[wild] < 0.02).all() and np.median(found.weights[~wild]) > 0.8
    np.testing.assert_allclose(found.noise, NOISE, rtol=0.15)


def noisy_regressors(seed, sd=0.03):
    """A line of four numbers whose columns are measured with noise; exact columns beside."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 20.0, 2000)
    exact = np.stack([np.sin(t), np.cos(1.7 * t), 0.2 * np.sin(5 * t), 0.1 * np.cos(9 * t)], 1)
    beta = np.array([1.0, -2.0, 3.0, 0.5])
    return exact, exact + sd * rng.normal(size=exact.shape), beta, rng


def test_noisy_regressors_bias_least_squares_but_not_instruments():
    errors = {"weighted": [], "instrumental": []}
    for seed in range(40):
        exact, X, beta, rng = noisy_regressors(seed)
        tau = exact @ beta + 0.05 * rng.normal(size=len(X))
        by_method = {"weighted": {}, "instrumental": {"instruments": exact[:, None]}}
        for method, options in by_method.items():
            found = sysid.torque.regress(X, tau, "abcd", method=method, **options)
            errors[method].append((found.beta - beta) / found.errors)
    bias = {m: np.abs(np.mean(e, axis=0)) for m, e in errors.items()}
    assert bias["weighted"].max() > 5  # 0.03^2 / (0.2^2 / 2): 4 % of the third number
    assert bias["instrumental"].max() < 4 / np.sqrt(40)
    scatter = np.std(errors["instrumental"], axis=0)
    np.testing.assert_allclose(scatter, 1.0, atol=0.45)  # 40 draws: 4 sd of a standard deviation


def test_instruments_of_the_last_estimate():
    """A function of the last estimate is called until it settles."""
    exact, X, beta, _ = noisy_regressors(0)
    seen = []

    def simulated(found):
        seen.append(found.beta)
        return exact[:, None] * (1 + 0.1 * (found.beta[0] - 1.0))  # depends on it, as a motion does

    tau = exact @ beta
    found = sysid.torque.regress(X, tau, "abcd", method="instrumental", instruments=simulated)
    assert found.success and found.steps == len(seen) < 8
    assert np.abs((found.beta - beta) / found.errors).max() < 4
    tired = sysid.torque.regress(
        X, tau, "abcd", method="instrumental", instruments=simulated, max_steps=1
    )
    assert not tired.success


@pytest.mark.slow
def test_instruments_of_the_simulated_arm():
    """Closed loop, encoders with noise, velocity and acceleration by differences (Janot 2014). What
    differences distort without any noise stays: about an error of one parameter."""
    model, dt = planar_2R(ARM), 0.005
    kp, kd = np.array([80.0, 30.0]), np.array([12.0, 2.5])

    def torque(t, state):
        along = 2 * np.pi * jnp.outer(jnp.array([0.4, 0.7, 1.1]), jnp.array([1.0, 1.3])) * t
        goal = jnp.array([-1.2, 0.5]) + 0.3 * jnp.sin(along).sum(0)
        return kp * (goal - state.q) - kd * state.v

    @jax.jit
    def loop(model):
        """q, v, a, tau of 1,000 samples."""
        start = rb.State(jnp.array([-1.2, 0.5]), jnp.zeros(2))
        path = rb.rollout(model, start, tau=torque, dt=dt, steps=1000, integrator="rk4")
        tau = jax.vmap(lambda t, q, v: torque(t, rb.State(q, v)))(path.ts, path.q, path.v)
        a = jax.vmap(functools.partial(rb.forward_dynamics, model))(path.q, path.v, tau)
        return path.q, path.v, a, tau

    def observed(q, v, a):
        return np.asarray(sysid.torque.regressor(model, q, v, a))

    q, v, a, tau = map(np.asarray, loop(model))
    names, pi = sysid.torque.parameter_names(model), np.asarray(rb.inertial_parameters(model))
    np.testing.assert_allclose(observed(q, v, a) @ pi, tau, atol=1e-9)
    base = sysid.statistics.combinations(observed(q, v, a), names)

    def simulated(found):
        now = sysid.parameters.with_inertial_parameters(model, found.parameters(pi))
        return observed(*loop(now)[:3])

    rng, off = np.random.default_rng(6), {"weighted": [], "instrumental": []}
    for _ in range(12):
        seen = q + 1e-4 * rng.normal(size=q.shape)
        speed = np.gradient(seen, dt, axis=0)
        W = observed(seen, speed, np.gradient(speed, dt, axis=0))[5:-5]
        y = (tau + 0.05 * rng.normal(size=tau.shape))[5:-5]
        for method, options in (
            ("weighted", {}),
            ("instrumental", {"instruments": lambda found: simulated(found)[5:-5]}),
        ):
            found = sysid.torque.regress(W, y, names, method=method, base=base, **options)
            assert found.success and found.steps <= 8
            off[method].append((found.beta - base.combine(pi)) / found.errors)
    biased, free = (np.abs(np.mean(off[m], 0)) for m in ("weighted", "instrumental"))
    assert biased.max() > 5 and free.max() < 1.5, (biased, free)


def test_the_method_may_be_a_function():
    names, W, tau, _, beta = experiment(100)

    def scaled(eq, *, factor):
        return dataclasses.replace(weighted(eq), beta=factor * weighted(eq).beta)

    found = sysid.torque.regress(W, tau, names, method=scaled, factor=2.0)
    assert np.allclose(found.beta, 2 * beta)
    with pytest.raises(UnknownName, match="factor"):
        sysid.torque.regress(W, tau, names, method=scaled, factors=2.0)


def test_the_place_of_a_wrong_number_is_named():
    names, W, tau, _, _ = experiment(100)
    odd = np.arange(200).reshape(100, 2) == 7
    with pytest.raises(InputError, match=r"tau\[3, 1\] is nan.*missing"):
        sysid.torque.regress(W, np.where(odd, np.nan, tau), names)
    with pytest.raises(InputError, match=r"noise\[3, 1\] is -2"):
        sysid.torque.regress(W, tau, names, noise=np.where(odd, -2.0, 1.0))
    with pytest.raises(InputError, match=r"noise is -1\.0"):
        sysid.torque.regress(W, tau, names, noise=-1.0)
    with pytest.raises(InputError, match="level is 2"):
        sysid.torque.regress(W, tau, names).intervals(2)
    with pytest.raises(InputError, match="prior has shape"):
        sysid.torque.regress(W, tau, names).parameters(np.zeros(3))
