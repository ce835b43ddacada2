"""The verdict on a run, from its numbers: it holds, or one of six failures.

    blows up             a state is not finite, or far larger than the motion
    root not found       the equations of an implicit step were not solved
    runs out of steps    the controller rejected or shortened steps until the budget was spent
    leaves the manifold  a quaternion's length, or a constraint, has a large error
    drifts               an invariant has a slope (`trend`) that is not small
    loses the motion     none of these, but the error is a tenth of the motion or more
The first in this order counts. A run without a failure holds, with its largest error.
"""

from __future__ import annotations

import enum
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbjax.arguments import real_array
from rbjax.errors import InputError
from rbjax.stability.runs.drift import trend

MOTION = 1e3  # sizes of the motion beyond which a state has blown up
LOSS = 0.1  # error, in sizes of the motion, beyond which the motion is lost


class Outcome(enum.Enum):
    """The possible outcomes of a run."""

    HOLDS = "holds"
    BLOWS_UP = "blows up"
    NO_ROOT = "root not found"
    OUT_OF_STEPS = "runs out of steps"
    OFF_MANIFOLD = "leaves the manifold"
    DRIFTS = "drifts"
    LOST = "loses the motion"


class Verdict(NamedTuple):
    """An outcome and its number.

    Fields: outcome; value: the largest error (holds, loses the motion), the time in s at which it
    ended (blows up, root not found, runs out of steps), the distance (leaves the manifold), or the
    change of the invariant that drifts, over its size; what, the name of that invariant, else "";
    error, the largest error while the state was sound, or None without a reference.
    """

    outcome: Outcome
    value: float
    what: str = ""
    error: float | None = None


def verdict(
    ts: ArrayLike,
    xs: ArrayLike,
    reference: ArrayLike | None = None,
    *,
    invariants: Mapping[str, ArrayLike] | None = None,
    manifold: ArrayLike | None = None,
    ending: Outcome | None = None,
    reached: float | None = None,
    size: float = 1.0,
    tolerance: float = 1e-3,
) -> Verdict:
    """The outcome of a run.

    max_k |x_k - r_k| while the state is sound; it is not if |x| > 1000 size.

    Args:
        ts: (T,) s.
        xs: (T,) or (T, n), the states, or the part of them to compare.
        reference: the same for the true motion, or None.
        invariants: name -> (T,), quantities that should be constant, each over its own scale.
        manifold: (T,) distances from the manifold, such as | |quaternion| - 1 |.
        ending: the failure that the solver reports, `Outcome.NO_ROOT`, `Outcome.OUT_OF_STEPS` or
            `Outcome.BLOWS_UP`; None if it reached the end.
        reached: time in s that the run reached; all of it if None.
        size: of the motion, in the units of xs.
        tolerance: above it the manifold is left, or a trend is a drift.

    Returns:
        `Verdict`; its numbers are finite, even if those of the run are not.

    Raises:
        InputError: wrong shapes; a reference or times that are not finite; a run without samples.

    Source: the failures in Hairer, Norsett & Wanner, *Solving ODEs*, I and II, and in Hairer,
    Lubich & Wanner, *Geometric Numerical Integration*.

    Example:
        >>> import numpy as np, rbjax as rb
        >>> t = np.linspace(0, 10, 101)
        >>> rb.stability.verdict(t, np.cos(t) + 1e-4 * t, np.cos(t)).outcome
        <Outcome.HOLDS: 'holds'>
        >>> found = rb.stability.verdict(t, np.exp(t), np.cos(t))
        >>> found.outcome.value, round(found.value, 1)
        ('blows up', 7.0)
    """
    t, x, r = _checked(ts, xs, reference)
    sound = np.isfinite(x).all(1)
    with np.errstate(invalid="ignore", over="ignore"):
        sound &= np.abs(x).max(1) <= MOTION * size
    end = len(t) if sound.all() else int(np.argmin(sound))  # samples before the first unsound
    last = t[-1] if reached is None else float(reached)
    alive = min(end, int(np.searchsorted(t, last, side="right")))
    error = None if r is None else float(np.abs(x - r)[:alive].max(initial=0.0))
    if (end < len(t) and t[end] <= last) or ending is Outcome.BLOWS_UP:
        return Verdict(Outcome.BLOWS_UP, float(min(last, t[min(end, len(t) - 1)])), "", error)
    if ending is not None:
        return Verdict(ending, last, "", error)
    off = 0.0 if manifold is None else _largest("manifold", manifold, len(t))
    if off > tolerance:
        return Verdict(Outcome.OFF_MANIFOLD, off, "", error)
    for name, series in (invariants or {}).items():
        found = trend(t, series)
        if found.drifts and abs(found.change) > tolerance:
            return Verdict(Outcome.DRIFTS, found.change, name, error)
    if error is not None and error >= LOSS * size:
        return Verdict(Outcome.LOST, error, "", error)
    return Verdict(Outcome.HOLDS, 0.0 if error is None else error, "", error)


def _checked(ts: ArrayLike, xs: ArrayLike, reference: ArrayLike | None) -> tuple:
    t, x = (
        real_array("verdict", name, y, "an array of numbers", finite=False)
        for name, y in (("ts", ts), ("xs", xs))
    )
    if t.ndim != 1 or not len(t) or x.shape[:1] != t.shape or x.ndim > 2:
        raise InputError(
            f"verdict: got ts {t.shape} and xs {x.shape}, expected (T,), and (T,) or (T, n)"
        )
    if not np.isfinite(t).all():
        raise InputError(
            "verdict: got times that are not finite; after an early end of a run of drift times "
            "are nan: give those of the whole run, and its ending"
        )
    r = None
    if reference is not None:
        r = real_array("verdict", "reference", reference, "an array of numbers", finite=False)
    if r is not None and r.shape != x.shape:
        raise InputError(f"verdict: got a reference {r.shape}, expected that of xs, {x.shape}")
    if r is not None and not np.isfinite(r).all():
        raise InputError("verdict: got a reference that is not finite, expected finite values")
    rows = (len(t), -1)
    return t, x.reshape(rows), None if r is None else r.reshape(rows)


def _largest(name: str, series: ArrayLike, length: int) -> float:
    x = real_array("verdict", "a series", series, "an array of numbers", finite=False)
    if x.shape != (length,) or not np.isfinite(x).all():
        raise InputError(f"verdict: {name} has shape {x.shape}, expected ({length},), all finite")
    return float(np.abs(x).max())
