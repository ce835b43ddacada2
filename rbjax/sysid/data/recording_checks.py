"""`findings`: what is odd in a recording, in sentences that name channel, column and sample.

    gap        the clock jumps: samples are missing
    dropped    samples are marked as not arrived
    still      a column never moves
    stuck      a column stops while the others of its sensor move: a sensor died
    outliers   samples far from their neighbours: a Hampel filter
    velocity   v is not the rate of q: a flipped sign, swapped joints, another unit, another clock
Findings are no errors: whoever fits decides. `Channel.drop` takes outliers out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy import integrate, ndimage

from rbjax.errors import InputError
from rbjax.sysid.data.recording import HELD, Channel, Recording

GAP = 3.0  # median steps of the clock
WINDOW = 7  # samples of the Hampel filter: three outliers in a row are still found
FAR = 8.0  # robust standard deviations: 1e-15 of normal noise
LONG = 0.1  # share of a recording during which a column that is stuck does not change
SLOPE = 0.05  # v over the rate of q may differ so much from 1
LAG = 0.05  # share of a recording over which positions are compared with integrated velocities


@dataclass(frozen=True)
class Finding:
    """One oddity: its kind, the channel, the column, the samples, and a sentence."""

    kind: str
    channel: str
    column: str
    samples: np.ndarray
    sentence: str

    def __str__(self) -> str:
        return self.sentence


def findings(recording: Recording) -> list[Finding]:
    """What is odd in a recording.

    Args:
        recording: any `Recording`.

    Returns:
        `Finding`s, channel by channel; none if all is well.

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
    if not isinstance(recording, Recording):
        raise InputError(
            f"findings: recording is {type(recording).__name__}, expected one Recording"
        )
    found: list[Finding] = []
    for sensor, channel in recording.channels.items():
        found += _of_clock(recording.name, sensor, channel)
        found += _of_columns(recording.name, sensor, channel)
    return [*found, *_of_velocities(recording)]


def _of_clock(name: str, sensor: str, c: Channel) -> Iterator[Finding]:
    steps = np.diff(c.t)
    jumps = np.flatnonzero(steps > GAP * c.step)
    if len(jumps) and sensor != HELD:  # commands may come when they change
        i = jumps[steps[jumps].argmax()]
        yield Finding(
            "gap", sensor, "", jumps + 1,
            f"{name}: channel {sensor}: the clock jumps at {_counted(jumps, 'sample')}, at most by "
            f"{steps[i]:.3g} s at sample {i + 1} (t = {c.t[i]:.6g} s), where a step is "
            f"{c.step:.3g} s; nothing is interpolated there",
        )  # fmt: skip


def _of_columns(name: str, sensor: str, c: Channel) -> Iterator[Finding]:
    spans = [float(np.ptp(_known(x))) for x in c.values.T]
    for j, column in enumerate(c.names):
        at, says = np.flatnonzero(c.arrived[:, j]), f"{name}: channel {sensor}: {column}"
        lost = np.flatnonzero(~c.arrived[:, j])
        if len(lost):
            yield Finding(
                "dropped", sensor, column, lost,
                f"{says} has {_counted(lost, 'sample')} that did not arrive, of {len(c.t)}; the "
                f"first is sample {lost[0]} (t = {c.t[lost[0]]:.6g} s)",
            )  # fmt: skip
        if not len(at):
            continue
        x = c.values[at, j]
        if spans[j] == 0:
            yield Finding(
                "still", sensor, column, at,
                f"{says} never moves: all {len(x)} samples are {x[0]:.6g}",
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
                    f"{says} stays at {x[first]:.6g} from sample {at[first]} to {at[last]} "
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
                f"{says} has {_counted(far, 'outlier')}; the farthest is sample {at[i]} "
                f"(t = {c.t[at[i]]:.6g} s): {x[i]:.6g}, away from its neighbours by "
                f"{away[i] / scale[i]:.3g} times their scatter",
            )  # fmt: skip


def hampel(x: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """How far each sample is from the median of its neighbours, and the scatter around it."""
    away = np.abs(x - ndimage.median_filter(x, WINDOW, mode="nearest"))
    # the scatter of the neighbours, so that fast motion is none, and that of the whole channel
    window = np.lib.stride_tricks.sliding_window_view(np.pad(x, WINDOW // 2, "edge"), WINDOW)
    local = np.median(np.abs(window - np.median(window, 1, keepdims=True)), 1)
    steps = np.abs(np.diff(x))
    usual = np.median(steps[steps > 0])  # at least an encoder's resolution
    return away, np.maximum(1.4826 * np.maximum(local, np.median(away)), max(noise, usual))


def _of_velocities(recording: Recording) -> Iterator[Finding]:
    """Changes of q over a lag beside the integral of v over the same lag."""
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
        slope = float(moved[i] @ turned[i]) / power  # of v on the rate of q
        best = int(np.argmax(likeness))
        says = f"{recording.name}: channel v: {n} is "
        if likeness[best] > 0.9 and likeness[i] < 0.7:
            says += f"not the rate of its q; that of {names[best]} is: are these joints swapped?"
        elif likeness[i] > 0.9 and abs(slope + 1) < SLOPE:
            says += "minus the rate of its q: one of the two has the wrong sign"
        elif likeness[i] > 0.9 and abs(slope - 1) > SLOPE:
            says += f"{slope:.4g} times the rate of its q: wrong units, sign or clock?"
        elif likeness[i] <= 0.9:
            says += f"not the rate of its q (correlation {likeness[i]:.2f})"
        else:
            continue
        yield Finding("velocity", "v", n, np.arange(0), says)


def _longest_pause(x: np.ndarray) -> tuple[int, int]:
    """First and last sample of the longest run of equal values."""
    starts = np.flatnonzero(np.append(True, np.diff(x) != 0))
    lengths = np.diff(np.append(starts, len(x)))
    k = int(lengths.argmax())
    return int(starts[k]), int(starts[k] + lengths[k] - 1)


def _known(x: np.ndarray) -> np.ndarray:
    known = x[~np.isnan(x)]
    return known if len(known) else np.zeros(1)


def _counted(items: np.ndarray, noun: str) -> str:
    return f"{len(items)} {noun}{'' if len(items) == 1 else 's'}"
