"""`findings`: probable mistakes in a recording, by channel, column and sample.

    gap        the clock jumps, since samples are missing
    dropped    samples are marked as missing
    still      a column is constant
    stuck      a column is constant while other columns of its sensor vary: a dead sensor
    outliers   samples are far from their neighbours, by a Hampel filter
    velocity   v is not the derivative of q: a wrong sign, swapped joints, a wrong unit or clock
`Channel.drop` removes outliers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import integrate, ndimage

from rbjax.arguments import instance
from rbjax.display import displayed
from rbjax.sysid.data.recording import HELD, Channel, Recording

GAP = 3.0  # least length of a gap, in median steps of the clock
WINDOW = 7  # samples of the Hampel filter, which finds up to three successive outliers
FAR = 8.0  # least distance of an outlier in robust standard deviations: 1e-15 of normal noise
LONG = 0.1  # least share of a recording with a constant value in a stuck column
SLOPE = 0.05  # largest deviation from 1 of the ratio of v to the derivative of q
LAG = 0.05  # time lag of the comparison of q with integrated v, as a share of a recording


@displayed
@dataclass(frozen=True)
class Finding:
    """A probable mistake in a recording.

    Fields:
        kind: "gap", "dropped", "still", "stuck", "outliers" or "velocity".
        channel: name of the channel.
        column: name of the column, or "".
        samples: (n,), indices of the samples.
        sentence: description for users.
    """

    kind: str
    channel: str
    column: str
    samples: np.ndarray
    sentence: str

    def __str__(self) -> str:
        return self.sentence


def findings(recording: Recording) -> list[Finding]:
    """Find probable mistakes in a recording, before a fit.

    Args:
        recording: the recording to check.

    Returns:
        List of `Finding`, channel by channel.

    Raises:
        InputError: not a `Recording`.

    Source: Hampel 1974 (outliers: |x_i - median| > 8 * 1.4826 MAD over 7 neighbours).

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid import Channel, Recording, findings
        >>> t = np.arange(100) / 100
        >>> q = np.stack([np.sin(7 * t), np.zeros(100)], 1)
        >>> run = Recording("swing", {"q": Channel(t, q, ("hip", "knee"))})
        >>> print(findings(run)[0])
        swing: channel q: knee never moves: all 100 samples are 0
    """
    instance("findings", "recording", recording, Recording, "one Recording")
    found: list[Finding] = []
    for sensor, channel in recording.channels.items():
        found += _check_clock(recording.name, sensor, channel)
        found += _check_columns(recording.name, sensor, channel)
    return [*found, *_check_velocities(recording)]


def _check_clock(name: str, sensor: str, c: Channel) -> Iterator[Finding]:
    steps = np.diff(c.t)
    jumps = np.flatnonzero(steps > GAP * c.step)
    if len(jumps) and sensor != HELD:  # commands may be logged only when they change
        i = jumps[steps[jumps].argmax()]
        yield Finding(
            "gap", sensor, "", jumps + 1,
            f"{name}: channel {sensor}: the clock jumps at {_counted(jumps, 'sample')}, at most by "
            f"{steps[i]:.3g} s at sample {i + 1} (t = {c.t[i]:.6g} s), where a step is "
            f"{c.step:.3g} s; nothing is interpolated there",
        )  # fmt: skip


def _check_columns(name: str, sensor: str, c: Channel) -> Iterator[Finding]:
    spans = [float(np.ptp(_known(x))) for x in c.values.T]
    for j, column in enumerate(c.names):
        at, start = np.flatnonzero(c.arrived[:, j]), f"{name}: channel {sensor}: {column}"
        lost = np.flatnonzero(~c.arrived[:, j])
        if len(lost):
            yield Finding(
                "dropped", sensor, column, lost,
                f"{start} has {_counted(lost, 'sample')} that did not arrive, of {len(c.t)}; the "
                f"first is sample {lost[0]} (t = {c.t[lost[0]]:.6g} s)",
            )  # fmt: skip
        if not len(at):
            continue
        x = c.values[at, j]
        if spans[j] == 0:
            yield Finding(
                "still", sensor, column, at,
                f"{start} never moves: all {len(x)} samples are {x[0]:.6g}",
            )  # fmt: skip
            continue
        if sensor == HELD:
            continue
        first, last = _longest_pause(x)
        if last - first >= max(20, LONG * len(x)):
            rows = slice(at[first], at[last] + 1)
            others = [k for k in range(len(c.names)) if k != j and spans[k] > 0]
            if any(np.ptp(_known(c.values[rows, k])) > LONG * spans[k] for k in others):
                yield Finding(
                    "stuck", sensor, column, at[first : last + 1],
                    f"{start} stays at {x[first]:.6g} from sample {at[first]} to {at[last]} "
                    f"(t = {c.t[at[first]]:.6g} to {c.t[at[last]]:.6g} s), while other columns "
                    "move: is the sensor dead?",
                )  # fmt: skip
        noise = 0.0 if c.noise is None else c.noise[j]
        away, scale = hampel(x, noise)
        far = np.flatnonzero(away > FAR * scale)
        if len(far):
            i = far[(away[far] / scale[far]).argmax()]
            yield Finding(
                "outliers", sensor, column, at[far],
                f"{start} has {_counted(far, 'outlier')}; the farthest is sample {at[i]} "
                f"(t = {c.t[at[i]]:.6g} s): {x[i]:.6g}, away from its neighbours by "
                f"{away[i] / scale[i]:.3g} times their scatter",
            )  # fmt: skip


def hampel(x: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Compute the distance of each sample from the median of its neighbours, and a robust scale."""
    away = np.abs(x - ndimage.median_filter(x, WINDOW, mode="nearest"))
    # the scatter is the larger one of the neighbours (fast motion) and of the whole channel
    window = np.lib.stride_tricks.sliding_window_view(np.pad(x, WINDOW // 2, "edge"), WINDOW)
    local = np.median(np.abs(window - np.median(window, 1, keepdims=True)), 1)
    steps = np.abs(np.diff(x))
    usual = np.median(steps[steps > 0])  # at least an encoder's resolution
    return away, np.maximum(1.4826 * np.maximum(local, np.median(away)), max(noise, usual))


def _check_velocities(recording: Recording) -> Iterator[Finding]:
    """Compare the change of q over a time lag with the integral of v over the same lag."""
    if not {"q", "v"} <= recording.channels.keys():
        return
    q, v = recording["q"], recording["v"]
    names = [n for n in q.names if n in v.names]
    t = q.t[(recording.start <= q.t) & (q.t <= recording.end)]
    lag = max(1, int(LAG * len(t)))
    if len(t) < 4 * lag or not names:
        return
    moved: list[np.ndarray] = []
    turned: list[np.ndarray] = []
    for n in names:
        x, y = q.values[:, q.names.index(n)], v.values[:, v.names.index(n)]
        a, b = ~np.isnan(x), ~np.isnan(y)
        if a.sum() < 2 or b.sum() < 2:
            return
        angle = integrate.cumulative_trapezoid(y[b], v.t[b], initial=0.0)
        for into, clock, z in ((moved, q.t[a], x[a]), (turned, v.t[b], angle)):
            there = np.interp(t, clock, z)
            into.append(there[lag:] - there[:-lag])
    for i, n in enumerate(names):
        power = float(moved[i] @ moved[i])
        if not (power > 0 and turned[i] @ turned[i] > 0):
            continue
        likeness = [abs(moved[i] @ d) / np.sqrt(power * (d @ d) or 1.0) for d in turned]
        slope = float(moved[i] @ turned[i]) / power  # regression of v on the derivative of q
        best = int(np.argmax(likeness))
        text = f"{recording.name}: channel v: {n} is "
        if likeness[best] > 0.9 and likeness[i] < 0.7:
            text += f"not the rate of its q, but like the rate of q of {names[best]}: swapped?"
        elif likeness[i] > 0.9 and abs(slope + 1) < SLOPE:
            text += "minus the rate of its q: one of the two has the wrong sign"
        elif likeness[i] > 0.9 and abs(slope - 1) > SLOPE:
            text += f"{slope:.4g} times the rate of its q: wrong units, sign or clock?"
        elif likeness[i] <= 0.9:
            text += f"not the rate of its q (correlation {likeness[i]:.2f})"
        else:
            continue
        yield Finding("velocity", "v", n, np.arange(0), text)


def _longest_pause(x: np.ndarray) -> tuple[int, int]:
    """Find the first and last index of the longest run of equal values."""
    starts = np.flatnonzero(np.append(True, np.diff(x) != 0))
    lengths = np.diff(np.append(starts, len(x)))
    k = int(lengths.argmax())
    return int(starts[k]), int(starts[k] + lengths[k] - 1)


def _known(x: np.ndarray) -> np.ndarray:
    """Return the samples that are not nan, or [0] if all are nan."""
    known = x[~np.isnan(x)]
    return known if len(known) else np.zeros(1)


def _counted(items: np.ndarray, noun: str) -> str:
    return f"{len(items)} {noun}{'' if len(items) == 1 else 's'}"
