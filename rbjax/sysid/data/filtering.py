"""Zero-phase low-pass filters, differentiation and interpolation of sampled signals.

A filter that runs forward and backward has no delay, and the square of the amplitude of one pass.
At the cut-off frequency the amplitude of both passes together is 1/sqrt(2).

    even clock      Butterworth of order n, forward and backward: |H|^2 = 1 / (1 + w^(2n)), where
                    w = tan(pi f h) / tan(pi f_0 h), and w^(2n) = sqrt(2) - 1 at the cut-off.
                    Derivatives are central differences over seven samples, with a relative error
                    of (w h)^6/140 (first) and (w h)^6/560 (second), w = 2 pi f
    uneven clock    smoothing spline: min sum_k w_k (x_k - s(t_k))^2 + lambda int s''^2, which is a
                    zero-phase filter 1 / (1 + lambda h (2 pi f)^4), h the mean step.
                    Derivatives are the derivatives of the spline.
White noise of standard deviation sigma becomes noise of standard deviation gain * sigma, with
    gain^2 = mean of |H(f) D(f)|^2 over the frequencies up to Nyquist's, D the difference operator
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import interpolate, signal
from scipy.spatial.transform import Rotation, Slerp

from rbjax.arguments import integer, real_array, real_number
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.model import Model

EVEN = 0.01  # largest relative deviation of the steps of an even clock
FLAT = 0.01  # largest relative deviation of the amplitude within the bandwidth
DECAYED = 0.01  # a smaller effect of an end of the signal is negligible
#: derivative -> weights of the samples k steps later, k = 1, 2, 3 (Fornberg 1988)
DIFFERENCES = {1: np.array([3 / 4, -3 / 20, 1 / 60]), 2: np.array([3 / 2, -3 / 20, 1 / 90])}
HALF_POWER = np.sqrt(2) - 1  # w^(2 n) at the cut-off


@displayed
@dataclass(frozen=True, eq=False)
class Filtered:
    """A filtered signal, or a derivative of a filtered signal.

    Fields:
        values: (T,) or (T, n), filtered values, in the shape of the signal.
        derivative: order of the derivative, 0, 1 or 2.
        cutoff: frequency in Hz with an amplitude of 1/sqrt(2) of the ideal one.
        bandwidth: frequency in Hz up to which the amplitude is within 1 % of the ideal one.
        gain: standard deviation of the result for white noise of standard deviation 1.
        settled: slice of the samples that the ends of the signal do not distort.
        method: description of the filter.
        delay: delay in s, always 0.
    """

    values: np.ndarray
    derivative: int
    cutoff: float
    bandwidth: float
    gain: float
    settled: slice
    method: str
    delay: float = 0.0


def low_pass(t: Any, x: Any, cutoff: float, *, derivative: int = 0, order: int = 4) -> Filtered:
    """Filter a signal by a zero-phase low-pass filter, and differentiate it.

    Args:
        t: (samples,) times in s. Uniform samples use a Butterworth filter, others a
            smoothing spline.
        x: (samples,) or (samples, columns) signal, without NaN.
        cutoff: frequency in Hz with an amplitude of 1/sqrt(2); below half the sample rate.
        derivative: order of the derivative, 0, 1 or 2.
        order: order of one pass of the Butterworth filter.

    Returns:
        `Filtered`: the values, in units of x per s or s^2 for a derivative, and the delay,
            bandwidth and gain of the filter.

    Raises:
        InputError: wrong shapes, values that are not finite, or a cut-off outside of (0, rate/2).

    Source: Gustafsson 1996 (forward and backward); Silverman 1984 (the spline as a filter).

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.data import low_pass
        >>> t = np.arange(1000) / 500
        >>> rate = low_pass(t, np.sin(2 * np.pi * t), cutoff=30.0, derivative=1)
        >>> error = abs(rate.values - 2 * np.pi * np.cos(2 * np.pi * t))[rate.settled]
        >>> bool(error.max() < 1e-3)
        True
    """
    where = "low_pass"
    times = integer(where, "derivative", derivative, least=0, most=2)
    integer(where, "order", order, least=1)
    t, x = _signal(where, t, x)
    steps = np.diff(t)
    h = float((t[-1] - t[0]) / len(steps))
    check_cutoff(where, "cutoff", cutoff, h)
    even = np.abs(steps - h).max() <= EVEN * h
    run = _butterworth if even else _spline
    return run(t, x, cutoff, times, order, h)


def check_cutoff(where: str, name: str, cutoff: Any, step: float) -> None:
    """Raise InputError unless a cut-off in Hz is below the Nyquist frequency 0.5 / step."""
    nyquist = 0.5 / step
    fix = f"a number between 0 and {nyquist:g} Hz, half the rate of the samples"
    if not real_number(where, name, cutoff, fix, above=0.0) < nyquist:
        raise InputError(f"{where}: {name} is {cutoff!r} Hz, expected {fix}")


def _butterworth(
    t: np.ndarray, x: np.ndarray, cutoff: float, times: int, order: int, h: float
) -> Filtered:
    warped = np.tan(np.pi * cutoff * h) / HALF_POWER ** (1 / (2 * order))
    sos = signal.butter(order, 2 * np.arctan(warped) / np.pi, output="sos")
    slowest = max(np.abs(signal.sos2zpk(sos)[1]).max(), 1e-3)
    ends = int(np.ceil(np.log(DECAYED) / np.log(slowest))) + 3 * (times > 0)
    smooth = signal.sosfiltfilt(sos, x, axis=0, padlen=min(len(x) - 1, 3 * ends))
    if times:
        smooth = _differences(smooth, times) / h**times

    def response(w: np.ndarray) -> np.ndarray:
        difference = np.ones_like(w)
        if times:
            phase = np.outer(w * h, [1, 2, 3])
            part = 2 * np.sin(phase) if times == 1 else 2 - 2 * np.cos(phase)
            difference = np.abs(part @ DIFFERENCES[times]) / h**times
        return np.abs(signal.freqz_sos(sos, w * h)[1]) ** 2 * difference

    method = f"Butterworth of order {order} forward and backward"
    method += ", central differences" if times else ""
    return _stated(smooth, times, cutoff, response, h, ends, method)


def _differences(x: np.ndarray, times: int) -> np.ndarray:
    """Compute central differences (samples, ...), with the signal reflected at its end points."""
    beyond = ((3, 3), *[(0, 0)] * (x.ndim - 1))
    x = np.pad(x, beyond, mode="reflect", reflect_type="odd")
    n, out = len(x) - 6, 0.0
    for k, weight in enumerate(DIFFERENCES[times], 1):
        later, earlier = x[3 + k : 3 + k + n], x[3 - k : 3 - k + n]
        out = out + weight * (later - earlier if times == 1 else later - 2 * x[3 : 3 + n] + earlier)
    return np.asarray(out)


def _spline(
    t: np.ndarray, x: np.ndarray, cutoff: float, times: int, order: int, h: float
) -> Filtered:
    stiffness = HALF_POWER / (2 * np.pi * cutoff) ** 4
    weights = np.gradient(t) / h  # the cut-off is the same for dense and sparse samples
    smooth = interpolate.make_smoothing_spline(t, x, w=weights, lam=stiffness / h, axis=0)

    def response(w: np.ndarray) -> np.ndarray:
        return w**times / (1 + stiffness * w**4)

    # the impulse response decays as exp(-w_0 |t| / sqrt(2))
    decay = np.sqrt(2) * stiffness**0.25
    ends = int(np.ceil(-np.log(DECAYED) * decay / h))
    values = np.asarray(smooth(t, times))
    return _stated(values, times, cutoff, response, h, ends, "smoothing spline")


def _stated(
    values: np.ndarray, times: int, cutoff: float, response: Any, h: float, ends: int, method: str
) -> Filtered:
    w = np.pi / h * (np.arange(20_000) + 0.5) / 20_000
    amplitude = response(w)
    off = np.abs(amplitude / w**times - 1) > FLAT
    bandwidth = w[off.argmax()] if off.any() else w[-1]
    gain = float(np.sqrt(np.mean(amplitude**2)))
    settled = slice(ends, max(ends, len(values) - ends))
    return Filtered(values, times, cutoff, bandwidth / (2 * np.pi), gain, settled, method)


def _signal(where: str, t: Any, x: Any) -> tuple[np.ndarray, np.ndarray]:
    t, x = (
        real_array(where, n, a, "an array of numbers", finite=False)
        for n, a in zip("tx", (t, x), strict=True)
    )
    if t.ndim != 1 or x.ndim not in (1, 2) or len(t) != len(x) or len(t) < 6:
        raise InputError(
            f"{where}: t has shape {t.shape} and x {x.shape}, expected (samples,), and (samples,) "
            "or (samples, columns), of at least 6 samples"
        )
    if not (np.isfinite(t).all() and (np.diff(t) > 0).all()):
        raise InputError(f"{where}: t does not increase, expected finite times that do")
    if not np.isfinite(x).all():
        at = np.argwhere(~np.isfinite(x))[0]
        raise InputError(
            f"{where}: x is {x[tuple(at)]} at sample {at[0]}, expected finite values; a filter "
            "would spread it: leave that sample out (the clock may be uneven), or cut the signal"
        )
    return t, x


#: tolerance of the length of a quaternion; least range of its entries over a rotation
UNIT, MOVES = 1e-3, 0.1


def quaternion_columns(sensor: str, values: np.ndarray, model: Model | None) -> tuple[int, ...]:
    """Find the first column of each quaternion (w, x, y, z) of a sensor.

    Without a model, any four successive columns of q that vary and have length 1 at every sample
    are a quaternion.
    """
    if sensor.startswith("pose:"):
        return (3,)
    if sensor != "q":
        return ()
    if model is not None:
        return model.topology.quaternion_starts
    found: list[int] = []
    k = 0
    while k + 4 <= values.shape[1]:
        four = values[:, k : k + 4]
        four = four[~np.isnan(four).any(1)]
        unit = len(four) > 1 and (np.abs(np.linalg.norm(four, axis=1) - 1) < UNIT).all()
        if unit and np.ptp(four, axis=0).max() > MOVES:
            found.append(k)
            k += 4
        else:
            k += 1
    return tuple(found)


def interpolate_columns(
    clock: np.ndarray, values: np.ndarray, t: np.ndarray, step: float, gap: float | None,
    turns: tuple[int, ...],
) -> np.ndarray:  # fmt: skip
    """Interpolate columns (samples, columns) at times t, by cubic splines and slerp.

    The result is nan if the samples are too far apart (`gap` of `Recording.on_clock`). `turns` are
    the first columns of quaternions.
    """
    measured = ~np.isnan(values)
    out = np.full((len(t), values.shape[1]), np.nan)
    longest = 3 * step if gap is None else gap
    for j, arrived in enumerate(measured.T):
        times = clock[arrived]
        if len(times) < 2:
            continue
        after = np.clip(np.searchsorted(times, t, side="left"), 1, len(times) - 1)
        before = after - 1
        known = (times[after] - times[before] <= longest) | np.isin(t, times)
        if gap is None:  # no sample was dropped in between
            places = np.flatnonzero(arrived)
            known &= (places[after] - places[before] == 1) | np.isin(t, times)
        known &= (times[0] <= t) & (t <= times[-1])
        out[known, j] = interpolate.CubicSpline(times, values[arrived, j])(t[known])
    for k in turns:
        four = slice(k, k + 4)
        arrived, known = measured[:, four].all(1), ~np.isnan(out[:, four]).any(1)
        out[:, four] = np.nan
        if arrived.sum() < 2:
            continue
        samples = Rotation.from_quat(values[arrived, four], scalar_first=True)
        at = np.clip(t[known], *clock[arrived][[0, -1]])
        out[known, four] = Slerp(clock[arrived], samples)(at).as_quat(scalar_first=True)
    return out
