"""Verdicts: recordings in which nothing moves, and those too short to judge, are never "good"."""

import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Channel, Recording, Status, Unknown, identify
from rbjax.sysid.estimators.verdict import constant_columns, is_poor, judge, without_outliers
from rbjax.sysid.simulation.traces import Trace
from rbjax.sysid.statistics import held_out
from rbjax.sysid.statistics.residual_tests import explained, varies

RNG = np.random.default_rng(0)
MASS = {"mass": Unknown("bodies.mass", 0, positive=True)}


def trace(recorded, simulated=None, names=("a", "b")):
    recorded = np.asarray(recorded, float)
    t = np.arange(len(recorded)) * 0.01
    simulated = recorded if simulated is None else np.asarray(simulated, float)
    return Trace(names[: recorded.shape[1]], t, recorded, simulated)


def run_of(values, name="run", noise=None):
    t = np.arange(len(values)) * 0.01
    return Recording(name, {"q": Channel(t, values, noise=noise)})


def verdict(recorded, simulated=None, noise=None, **how):
    """That of a fit that has converged and leaves no colour."""
    seen = {"run": {"q": trace(recorded, simulated)}}
    return judge(Status.CONVERGED, seen, [run_of(recorded, noise=noise)], (), **how)


WAVE = np.sin(0.1 * np.arange(200))[:, None]


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("value", [0.0, 0.1, -3.0, 1e3, 1e-12])
@pytest.mark.parametrize("rows", [1, 12, 200])
def test_whether_columns_vary(dtype, value, rows):
    """Whatever the size, and whatever the mean's rounding makes of a constant."""
    x = np.full((rows, 2), value, dtype)
    assert not varies(x).any()
    x[0, 1] = np.nan  # what did not arrive says nothing
    assert not varies(x).any()
    if rows > 1:
        x[-1, 0] = value * (1 + 1e-3) + 1e-15
        assert varies(x).tolist() == [True, False]
    assert not varies(np.full((rows, 2), np.nan)).any()


def test_the_share_of_variance_by_hand():
    y, r = np.array([[0.0], [2.0]]), np.array([[0.5], [-0.5]])
    assert explained([y], [r]) == 1 - 0.5 / 2
    # a constant recording has no variance, but its residual counts
    still = np.array([[7.0], [7.0]])
    assert explained([y, still], [r, r]) == 1 - 1.0 / 2
    assert np.isnan(explained([still], [0 * r])) and np.isnan(explained([still], [r]))
    # a constant column beside one that moves
    assert explained([np.hstack([y, still])], [np.hstack([r, r])]) == 1 - 1.0 / 2


@pytest.mark.parametrize("noise", [None, [1e-3]])
@pytest.mark.parametrize("off", [0.0, 1e-17, 1e-4])
@pytest.mark.parametrize("value", [0.0, 0.1])
def test_a_recording_in_which_nothing_moves_is_never_good(noise, off, value):
    """Not even one that is fitted exactly; no other start is tried for it."""
    y = np.full((101, 1), value)
    found = verdict(y, y + off, noise)
    assert not found.success and np.isnan(found.r_squared["q"])
    assert "nothing moves (q of a is constant in all recordings)" in found.summary()
    assert found.constant == {"q": ("a",)}
    assert not is_poor({"run": {"q": trace(y, y + off)}}, [run_of(y)], None)


def test_a_column_that_is_constant_is_named():
    y = np.hstack([WAVE, np.full_like(WAVE, 0.3)])
    noise = 1e-3 * RNG.normal(size=y.shape) * [1, 0]
    found = verdict(y + noise, y)
    assert found.success and found.constant == {"q": ("b",)}
    assert found.summary().endswith("; q of b is constant, which no model of a motion can explain")
    assert found.r_squared["q"] > 0.999
    every = {"x": {"q": trace(y)}, "y": {"q": trace(WAVE * [1, 1])}}
    assert constant_columns(every) == {}  # in one of the two it moves
    assert verdict(WAVE + 1e-3 * RNG.normal(size=WAVE.shape), WAVE).constant == {}


def test_noise_about_a_point_is_no_motion():
    y = 0.1 + 1e-3 * RNG.normal(size=(200, 1))
    found = verdict(y, np.full_like(y, 0.1))
    assert not found.success and "by no more than its noise" in found.summary()
    found = verdict(y, np.full_like(y, 0.1), [1e-3])
    assert not found.success and "by no more than its noise" in found.summary()
    assert "by no more than" not in verdict(WAVE, 0 * WAVE).summary()


def with_outliers(share, size=0.04, noise=2e-3, count=400):
    rng = np.random.default_rng(3)
    y = np.sin(0.05 * np.arange(count))[:, None] * [1, 2]
    off = noise * rng.normal(size=y.shape)
    return y + off + size * (rng.random(y.shape) < share), y


@pytest.mark.parametrize("stated", [True, False])
def test_outliers_do_not_count_in_the_verdict_of_a_robust_fit(stated):
    """5 % of the samples, 20 times the stated noise: the noise that is left is the stated one."""
    recorded, simulated = with_outliers(0.05)
    noise = [2e-3, 2e-3] if stated else None
    found = verdict(recorded, simulated, noise, robust=True)
    assert found.success and abs(found.outliers["q"] - 0.05) < 0.02
    assert "outliers do not count" in found.summary()
    if stated:
        assert 0.9 < found.noise_ratio["q"] < 1.1
        assert not verdict(recorded, simulated, noise).success  # of least squares they are errors
    seen = {"run": {"q": trace(recorded, simulated)}}
    assert not is_poor(seen, [run_of(recorded, noise=noise)], None, robust=True)
    left, shares = without_outliers(seen)
    assert shares == found.outliers and np.nanmax(np.abs(left["run"]["q"].residual)) < 8.1e-3


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_how_many_outliers_are_too_many(share):
    recorded, simulated = with_outliers(share)
    found = verdict(recorded, simulated, [2e-3, 2e-3], robust=True)
    assert found.success == (share == 0.0) and ("are outliers, above 20 %" in found.summary()) == (
        share == 0.3
    )
    wrong = verdict(recorded, 1.02 * simulated, [2e-3, 2e-3], robust=True)
    assert (
        not wrong.success
    )  # a model that is wrong everywhere has no outliers, but too large errors
    seen = {"run": {"q": trace(recorded, simulated)}}
    why = is_poor(seen, [run_of(recorded)], None, robust=True)
    assert ("are outliers" in why) == (share == 0.3)


def test_an_attitude_is_an_outlier_as_a_whole():
    q = np.tile([1.0, 0.0, 0.0, 0.0], (50, 1)) + 1e-3 * RNG.normal(size=(50, 4))
    wild = q.copy()
    wild[7, 2] += 0.5
    seen = {"run": {"q": Trace(tuple("wxyz"), np.arange(50) * 0.01, wild, q + 1e-3, (0,))}}
    left, _ = without_outliers(seen)
    assert np.isnan(left["run"]["q"].recorded[7]).all()


def test_too_few_samples_to_judge():
    found = verdict(WAVE[:9], WAVE[:9])
    assert not found.success and "10 samples, which are too few" in found.summary()
    # one recording is long enough
    seen = {"run": {"q": trace(WAVE)}, "b": {"q": trace(WAVE[:5])}}
    both = judge(Status.CONVERGED, seen, [run_of(WAVE), run_of(WAVE[:5], "b")], ())
    assert both.success and both.r_squared["q"] == 1


def test_held_out_recordings_in_which_nothing_moves():
    y = {"b": np.full((50, 1), 0.1)}
    r = {"b": 1e-3 * RNG.normal(size=(50, 1))}
    found = held_out({"a": r["b"]}, r, measured=y, noise=1e-3)
    assert not found.success and np.isnan(found.r_squared)
    assert found.summary().startswith("the model is not tested") and "constant" in found.failed[0]
    assert "nan" not in found.summary()


@pytest.mark.slow
def test_a_pendulum_that_stays_where_gravity_pulls_it():
    """0.1 rad off the vertical without a torque: only a pendulum without mass does that."""
    t = np.arange(101) * 0.01
    run = Recording("rest", {"q": Channel(t, np.full((101, 1), 0.1))})
    found = identify(rb.load("pendulum"), run, MASS)
    assert not found.verdict.success and not found.notes
    assert "nothing moves (q of hinge is constant" in found.summary()
