"""Covariance and intervals against exact fractions, closed forms and Monte Carlo."""

from fractions import Fraction

import numpy as np
import pytest
from scipy import stats

import rbjax as rb
from rbjax.sysid.statistics import estimates
from tests.oracles import load
from tests.tolerances import F64_ROUNDING, relative_error

ORACLE = load("excitation")["crlb"]
T = np.arange(1, 11) / 10


def exact(rows):
    return np.array([[float(Fraction(x)) for x in np.atleast_1d(row)] for row in rows])


def decay(p, t=T):
    return p[0] * np.exp(-p[1] * t)


def decay_jacobian(p, t=T):
    e = np.exp(-p[1] * t)
    return np.stack([e, -p[0] * t * e], -1)


def test_a_weighted_line_in_exact_fractions():
    line = ORACLE["linear"]
    X, sigma, y = np.array(line["X"], float), np.sqrt(line["S"]), np.array(line["y"], float)
    p = np.linalg.lstsq(X / sigma[:, None], y / sigma, rcond=None)[0]
    assert relative_error(p, exact(line["best_linear_estimate"])[:, 0]) < F64_ROUNDING
    found = estimates(("offset", "slope"), p, X, sigma)
    assert relative_error(found.covariance, exact(line["crlb"])) < F64_ROUNDING
    half = line["normal_975"] * np.sqrt(line["crlb_decimal"][1][1])
    low, high = found.interval("slope")[2:]
    assert relative_error([low, high], [p[1] - half, p[1] + half]) < F64_ROUNDING
    student = estimates(("offset", "slope"), p, X, sigma, dof=3).interval("slope")
    factor = line["student_t_975_3_degrees"] / line["normal_975"]
    assert abs((student.high - p[1]) / half / factor - 1) < 1e-12
    # a sum of the two: its variance has the covariance in it
    together = found.interval({"offset": 1.0, "slope": 2.0})
    (a, b), (_, c) = exact(line["crlb"])
    assert abs(together.sigma**2 / (a + 4 * b + 4 * c) - 1) < F64_ROUNDING


def test_unknown_noise_and_uneven_noise():
    """Ordinary least squares: s^2 (X^T X)^-1 with s^2 = r^T r / (m - n)."""
    line = ORACLE["linear"]
    X, y = np.array(line["X"], float), np.array(line["y"], float)
    p = exact([line["ordinary_least_squares"]])[0]
    r = y - X @ p
    found = estimates(("offset", "slope"), p, X, residual=r)
    np.testing.assert_allclose(found.covariance, r @ r / 3 * np.linalg.inv(X.T @ X), rtol=1e-13)
    assert found.dof == 3


def test_the_bound_of_a_decay():
    case, p = ORACLE["decay"], (2.0, 1.5)
    found = estimates(("A", "rate"), p, decay_jacobian(p), 0.05)
    assert relative_error(found.covariance, case["covariance"]) < 1e-13
    assert relative_error(found.sigma, case["sigma"]) < 1e-13
    assert found.correlation[0, 0] == pytest.approx(1, abs=1e-14) and not found.free.size


def not_identifiable(m=2.0, b=0.5, **options):
    v = np.exp(-b / m * T)
    J = np.stack([v * T * b / m**2, -v * T / m], 1)
    return estimates(("m", "b"), (m, b), J, 0.01, **options), J


def test_what_data_do_not_show_has_no_interval():
    case, (found, _) = ORACLE["not_identifiable"], not_identifiable()
    assert found.free.shape == (2, 1)
    assert relative_error(found.free[:, 0], case["null_direction"]) < 1e-12
    for name in ("m", "b"):
        assert found.interval(name)[1:] == (np.inf, -np.inf, np.inf)
    assert np.isinf(found.interval({"m": 1.0, "b": 1.0}).sigma)
    ratio = found.interval(lambda p: p["b"] / p["m"])
    assert abs(ratio.sigma / case["sigma_of_b_over_m"] - 1) < 1e-12 and ratio.value == 0.25
    assert abs(ratio.high - ratio.value - 1.959963984540054 * ratio.sigma) < 1e-14
    positive, _ = not_identifiable(bounds={"m": (0, np.inf)})
    assert positive.interval("m")[2:] == (0, np.inf)
    words = found.sentences()
    assert words[0] == "m: these data do not identify it"
    assert words[-1].startswith("free: a change along (+0.97 m, +0.243 b)")


@pytest.mark.parametrize("scale", [1e-8, 1.0, 1e8])
def test_units_do_not_decide_what_is_seen(scale):
    """A parameter in other units has another column; one that moves nothing has none."""
    J = np.stack([T**0 * scale, T / scale, 0 * T], 1)
    found = estimates("abc", np.ones(3), J, 0.1)
    finite = np.isfinite(found.sigma)
    assert finite.tolist() == [True, True, False]
    plain = estimates("ab", np.ones(2), np.stack([T**0, T], 1), 0.1).sigma
    assert relative_error(found.sigma[:2] * [scale, 1 / scale], plain) < 1e-12


def test_intervals_keep_within_bounds():
    J = np.eye(4)
    bounds = {"b": (0, np.inf), "c": (-1, 1), "d": (-np.inf, 3)}
    found = estimates("abcd", [0.5, 0.5, 0.5, 0.5], J, 1.0, bounds=bounds)
    z = stats.norm.ppf(0.975)
    at = {n: found.interval(n) for n in "abcd"}
    np.testing.assert_allclose(at["a"][2:], [0.5 - z, 0.5 + z])
    np.testing.assert_allclose(at["b"][2:], [0.5 * np.exp(-2 * z), 0.5 * np.exp(2 * z)])
    u, du = np.log(1.5 / 0.5), z * (1 / 1.5 + 1 / 0.5)
    logistic = [2 / (1 + np.exp(-u + du)) - 1, 2 / (1 + np.exp(-u - du)) - 1]
    np.testing.assert_allclose(at["c"][2:], logistic, rtol=1e-12)
    np.testing.assert_allclose(at["d"][2:], 3 - 2.5 * np.exp([z / 2.5, -z / 2.5]))
    on_it = estimates("b", [0.0], [[1.0]], 1.0, bounds={"b": (0, np.inf)}).interval("b")
    np.testing.assert_allclose(on_it[2:], [0, z])


def test_intervals_of_unknown_names_and_levels_are_errors():
    found = estimates("abc", np.ones(3), np.eye(5)[:, :3], 1.0)
    with pytest.raises(rb.UnknownName, match="parameter 'x'"):
        found.interval("x")
    with pytest.raises(rb.InputError, match="level is 95, expected"):
        found.interval("a", level=95)
