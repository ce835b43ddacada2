"""`low_pass` against sines, whose response is known, and against noise."""

import numpy as np
import pytest

from rbjax.sysid.data import low_pass

RATE, CUTOFF = 500.0, 20.0
EVEN = np.arange(3000) / RATE
rng = np.random.default_rng(0)
UNEVEN = EVEN + rng.uniform(-0.4, 0.4, EVEN.size) / RATE
CLOCKS = pytest.mark.parametrize("t", [EVEN, UNEVEN], ids=["even", "uneven"])


def response(t, y, f):
    """Amplitude and phase of y at a frequency, by least squares on the middle."""
    mid = slice(len(t) // 6, -(len(t) // 6))
    basis = np.stack([np.sin(2 * np.pi * f * t), np.cos(2 * np.pi * f * t)], 1)[mid]
    c, s = np.linalg.lstsq(basis, y[mid], rcond=None)[0]
    return np.hypot(c, s), np.arctan2(s, c)


@CLOCKS
@pytest.mark.parametrize("f", [1.0, 8.0, CUTOFF, 60.0])
def test_amplitude_and_phase_of_sines(t, f):
    """1/(1 + (sqrt 2 - 1) w^(2n)), w of the bilinear transform; n = 2 for the spline, without it.
    On an uneven clock a sine is seen through about 25 samples: 1 % of amplitude and phase."""
    out = low_pass(t, np.sin(2 * np.pi * f * t), CUTOFF)
    amplitude, phase = response(t, out.values, f)
    w = np.tan(np.pi * f / RATE) / np.tan(np.pi * CUTOFF / RATE) if t is EVEN else f / CUTOFF
    expected = 1 / (1 + (np.sqrt(2) - 1) * w ** (8 if t is EVEN else 4))
    assert abs(amplitude - expected) < (1e-6 if t is EVEN else 0.01)
    if f <= CUTOFF:
        assert abs(phase) < (1e-6 if t is EVEN else 0.01)
    assert out.delay == 0 and out.cutoff == CUTOFF


def test_the_cut_off_is_the_same_where_samples_are_dense():
    """200 Hz for 6 s, then 1000 Hz for 6 s: a sine of the cut-off leaves as 1/sqrt(2) in both."""
    t = np.concatenate([np.arange(0, 6, 1 / 200), np.arange(6, 12, 1 / 1000)])
    out = low_pass(t, np.sin(2 * np.pi * 10 * t), 10.0).values
    for half in (t < 6, t >= 6):
        amplitude, _ = response(t[half], out[half], 10.0)
        assert abs(amplitude - np.sqrt(0.5)) < 0.01


@CLOCKS
def test_the_bandwidth_is_that_of_one_percent(t):
    out = low_pass(t, np.sin(t), CUTOFF)
    f = out.bandwidth
    amplitude, _ = response(t, low_pass(t, np.sin(2 * np.pi * f * t), CUTOFF).values, f)
    assert 2 < f < CUTOFF and abs(amplitude - 0.99) < (1e-4 if t is EVEN else 2e-3)


@pytest.mark.parametrize("times", [1, 2])
def test_the_error_of_a_derivative_is_of_sixth_order(times):
    """Far below the cut-off: (w h)^6/140 of the first derivative, (w h)^6/560 of the second."""
    w, errors = 2 * np.pi * 10.0, []
    for rate in (100.0, 150.0):
        t = np.arange(0, 12, 1 / rate)
        out = low_pass(t, np.sin(w * t), 0.45 * rate, derivative=times, order=12)
        exact = w * np.cos(w * t) if times == 1 else -(w**2) * np.sin(w * t)
        error = np.abs(out.values - exact)[400:-400].max()
        assert abs(error / (w**times * (w / rate) ** 6 / (140, 560)[times - 1]) - 1) < 0.15
        errors.append(error)
    assert abs(errors[0] / errors[1] / 1.5**6 - 1) < 0.2


@pytest.mark.parametrize("times", [1, 2])
def test_derivatives_of_a_coarse_clock_are_not_too_small(times):
    """A drive read at 33 Hz that moves at 4 Hz: three-point differences lose 9 % and 4.5 %."""
    t, w = np.arange(0, 20, 0.03), 2 * np.pi * 4.0
    out = low_pass(t, np.sin(w * t), 13.0, derivative=times)
    amplitude, _ = response(t, out.values, 4.0)
    assert abs(amplitude / w**times - 1) < 2e-3


@CLOCKS
@pytest.mark.parametrize("times", [0, 1, 2])
def test_derivatives_and_noise_as_stated(t, times):
    w = 2 * np.pi * 3.0
    exact = [np.sin(w * t), w * np.cos(w * t), -(w**2) * np.sin(w * t)][times]
    clean = low_pass(t, np.sin(w * t), CUTOFF, derivative=times)
    error = np.abs(clean.values - exact)[clean.settled].max() / w**times
    assert error < 0.01  # 3 Hz is within the bandwidth
    noise = rng.normal(size=(t.size, 20))
    noisy = low_pass(t, noise, CUTOFF, derivative=times)
    spread = noisy.values[noisy.settled].std()
    # 20 signals of about 80 independent samples a second: 2 %; jitter adds a little
    assert abs(spread / clean.gain - 1) < (0.05 if t is EVEN else 0.1)
    assert noisy.gain == clean.gain


def test_columns_are_filtered_each():
    x = rng.normal(size=(300, 3))
    for t in (EVEN[:300], UNEVEN[:300]):
        together = low_pass(t, x, CUTOFF, derivative=2).values
        single = [low_pass(t, c, CUTOFF, derivative=2).values for c in x.T]
        np.testing.assert_allclose(together.T, single, rtol=1e-9, atol=1e-6)
