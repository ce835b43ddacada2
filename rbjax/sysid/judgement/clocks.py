"""How fast the clock of the sensors runs beside that of the commands, from one simulated motion.

A recording y whose clock runs at 1 / (1 + b) of the right rate lags more and more behind a
simulated motion s. Wrong numbers of the model make a lag, too, a gain and an offset, but those stay
the same. So each column is fitted by three numbers for every rate b, to first order in the lag,

    y(t) ~ c + a s((1 + b) t) + d s'((1 + b) t)
and the rate is that at which least of the variance is left. No constant lag or gain, such as those
of a servo with wrong friction or a wrong delay, can hide it. Parameters that were fitted to a wrong
clock can hide a part of it: a motion of the first guess shows it better.

Source: Knapp & Carter 1976, IEEE Trans. ASSP 24(4) (delays by likelihood); linear least squares.
"""

from __future__ import annotations

import numpy as np

from rbjax.sysid.simulation.traces import FEW, Trace, Traces

#: rates that are tried
RATES = np.linspace(-0.05, 0.05, 201)
#: the variance that a rate may leave, of what no rate leaves: of a motion too short or too plain to
#: show a clock nearly all of it stays
LEFT = 0.5


def rate_of(seen: Traces) -> float:
    """The rate b of the sensors' clock: their times times 1 + b are those of the commands.

    Args:
        seen: recorded beside simulated motion, by recording and sensor.

    Returns:
        One of `RATES`; 0 where no rate explains the recordings much better than none.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid import Trace
        >>> t = np.arange(600) * 0.005
        >>> late = 0.8 * np.sin(9 * t / 1.02 - 0.1)[:, None]  # the clock 2 % fast, gain and lag
        >>> seen = {"swing": {"q": Trace(("hip",), t, late, np.sin(9 * t)[:, None])}}
        >>> print(round(rate_of(seen), 4))
        -0.0195
    """
    left = np.zeros(len(RATES))
    for sensors in seen.values():
        for trace in sensors.values():
            if trace.measured:
                left += _left(trace)
    k = int(np.argmin(left))
    return float(RATES[k]) if left[k] <= LEFT * left[len(RATES) // 2] else 0.0


def _left(trace: Trace) -> np.ndarray:
    """At each rate the share of the variance that is left, summed over the columns."""
    left = np.zeros(len(RATES))
    rise = np.gradient(trace.simulated, trace.t, axis=0)
    for y, s, ds in zip(trace.recorded.T, trace.simulated.T, rise.T, strict=True):
        known = ~np.isnan(y)
        if known.sum() < FEW or np.ptp(y[known]) == 0:
            continue
        for k, b in enumerate(RATES):
            t = trace.t[known] * (1 + b)
            inside = t <= trace.t[-1]
            t, seen = t[inside], y[known][inside]
            rows = [np.ones(len(t)), np.interp(t, trace.t, s), np.interp(t, trace.t, ds)]
            A = np.stack(rows, 1)
            off = seen - A @ np.linalg.lstsq(A, seen, rcond=None)[0]
            left[k] += (off @ off) / max(len(t) * seen.var(), 1e-300)
    return left
