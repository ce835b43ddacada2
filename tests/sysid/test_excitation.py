"""Fourier series and splines: the oracle's values, scipy's splines, derivatives by JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import interpolate

from rbjax.sysid.design import Fourier, Spline
from rbjax.sysid.design.experiments import CRITERIA
from rbjax.sysid.statistics import estimates
from tests.oracles import load
from tests.sysid.two_link import regressor
from tests.tolerances import GRADIENT, relative_error

ORACLE = load("excitation")["fourier_excitation"]
SERIES = Fourier(*(jnp.array(ORACLE[n]) for n in ("q0", "a", "b")), period=ORACLE["T"])
TIMES = jnp.arange(1000) * ORACLE["T"] / 1000
ARM = ORACLE["regressor_2R"]


def in_order(series):
    """The oracle's order of gradients."""
    return np.concatenate([np.ravel(series.a), np.ravel(series.b), series.q0])


def test_values_of_the_series():
    t = jnp.array([p["t"] for p in ORACLE["points"]])
    assert len(t) == 8
    for got, name in zip(SERIES(t), ("q", "qd", "qdd"), strict=True):
        assert relative_error(got, [p[name] for p in ORACLE["points"]]) < 1e-12
    q, v, a = SERIES(TIMES)
    extremes = ORACLE["extremes_over_samples"]
    for got, name in ((q.min(0), "q_min"), (q.max(0), "q_max"), (abs(v).max(0), "qd_abs"),
                      (abs(a).max(0), "qdd_abs")):  # fmt: skip
        assert relative_error(got, extremes[name]) < 1e-12
    assert SERIES.duration == 10


def test_information_of_the_arm_with_two_joints():
    """Condition 36, and 1,326 that of W^T W, whose rounding the eigenvalues see: 1e-11."""
    W = regressor(*SERIES(TIMES))
    assert W.shape == (2000, 6)
    F = W.T @ W
    singular = np.sqrt(np.linalg.eigvalsh(F)[::-1])
    assert relative_error(singular, ARM["singular_values"]) < 1e-12
    assert relative_error(np.linalg.norm(W, axis=0), ARM["column_norms"]) < 1e-12
    assert abs(-6 * CRITERIA["D"](F) / ARM["logdet_of_WtW"] - 1) < 1e-12
    assert abs(np.exp(CRITERIA["condition"](F)) / ARM["condition_number"] - 1) < 1e-11
    scaled = W / jnp.linalg.norm(W, axis=0)
    condition = np.exp(CRITERIA["condition"](scaled.T @ scaled))
    assert abs(condition / ARM["condition_number_columns_scaled"] - 1) < 1e-12


def test_gradients_of_log_determinant_and_condition():
    def information(series):
        W = regressor(*series(TIMES))
        return W.T @ W

    F, pull = jax.vjp(information, SERIES)
    for name, factor, key in (
        ("D", -6.0, "gradient_of_logdet"),
        ("condition", ARM["condition_number"], "gradient_of_condition_number"),
    ):
        slope = pull(jax.grad(CRITERIA[name])(F))[0]
        got = factor * in_order(slope)
        assert relative_error(got, ARM[key]) < 1e-10


@pytest.mark.parametrize("name", CRITERIA)
def test_criteria_and_their_gradients(name):
    rng = np.random.default_rng(0)
    X, E = rng.normal(size=(2, 9, 4))
    F, E = X.T @ X, E.T @ E
    values = np.linalg.eigvalsh(F)
    exact = {
        "D": -np.log(values).mean(),
        "A": np.log((1 / values).sum()),
        "E": -np.log(values[0]),
        "condition": 0.5 * np.log(values[-1] / values[0]),
    }
    assert abs(CRITERIA[name](F) / exact[name] - 1) < 1e-12
    h = 1e-5
    slope = (CRITERIA[name](F + h * E) - CRITERIA[name](F - h * E)) / (2 * h)
    got = np.sum(np.asarray(jax.grad(CRITERIA[name])(jnp.asarray(F))) * E)
    assert abs(got - slope) < 10 * GRADIENT * abs(slope) + 1e-9


def test_bound_of_the_base_parameters():
    W = np.asarray(regressor(*SERIES(TIMES)))
    bound = estimates(list("abcdef"), np.zeros(6), W, np.tile([0.1, 0.05], 1000)).covariance
    case, truth = ORACLE["crlb"], ORACLE["truth"]
    assert relative_error(np.sqrt(np.diag(bound)), case["sigma_of_p"], floor=1e-9) < 1e-12
    assert relative_error(bound, case["covariance"], floor=1e-9) < 1e-12
    tau = (W @ truth["p"]).reshape(-1, 2)
    expected = [truth["torque_first_sample"], truth["torque_sample_250"]]
    assert relative_error(tau[[0, 250]], expected) < 1e-12


SPLINE = Spline.random(jax.random.key(1), jnp.array([0.3, -0.2]), 6, duration=4.0, size=0.5)


def test_splines_are_those_of_scipy_and_rest_at_their_ends():
    t = np.linspace(0, 4, 101)
    q, v, a = SPLINE(t)
    points = np.asarray(SPLINE.points)
    c = np.concatenate([points[:, :1]] * 2 + [points] + [points[:, -1:]] * 2, 1).T
    knots = np.concatenate([[0] * 5, np.linspace(0, 4, 6), [4] * 5])
    whole = interpolate.BSpline(knots, c, 5)
    for times, got in enumerate((q, v, a)):
        expected = whole.derivative(times)(t) if times else whole(t)
        np.testing.assert_allclose(got, expected, atol=1e-12)
    for x in (v, a):
        np.testing.assert_allclose(x[jnp.array([0, -1])], 0, atol=1e-13)
    np.testing.assert_allclose(q[jnp.array([0, -1])], [[0.3, -0.2]] * 2, atol=1e-15)


@pytest.mark.parametrize("motion", [SERIES, SPLINE], ids=["fourier", "spline"])
def test_velocities_and_accelerations_are_derivatives(motion):
    t = jnp.linspace(0.05, 3.9, 23)  # between knots
    rates = jax.jvp(motion, (t,), (jnp.ones_like(t),))[1]
    np.testing.assert_allclose(rates.q, motion(t).v, atol=1e-12)
    np.testing.assert_allclose(rates.v, motion(t).a, atol=1e-12)


def test_random_motions():
    one = Fourier.random(jax.random.key(0), jnp.zeros(3), 40, period=5.0, speed=0.3)
    v = one(jnp.arange(200) * 5 / 200).v
    # a and b of each harmonic: sum of (a^2 + b^2)/2 has the mean speed^2; 120 of each: 10 %
    assert abs(np.sqrt(np.mean(v**2)) / 0.3 - 1) < 0.15
