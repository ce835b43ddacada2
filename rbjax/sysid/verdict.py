"""`Verdict`: whether a fit is good, from the data that it was fitted to."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbjax.sysid.columns import root_mean_square
from rbjax.sysid.comparison import EXPLAINED, NOISY
from rbjax.sysid.recording import HELD, Recording
from rbjax.sysid.runs import ordered
from rbjax.sysid.simulation import Setup
from rbjax.sysid.traces import FEW, Trace, Traces, together
from rbjax.sysid.variance import explained, varies

#: residuals this many times the roughness of the recordings are not noise
ROUGH = 3.0
#: a fit that explains more than this share of the variance is at the right minimum
CLOSE = 0.999
#: residuals below this share of the spread are rounding, or the error of integration
TINY = 1e-5
#: a sensor whose values spread by no more than so many times their noise shows no motion
STILL = 2.0


@dataclass(frozen=True)
class Verdict:
    """Whether a fit is good.

    Fields:
        good: whether all checks pass.
        failed: a sentence for each check that does not.
        r_squared: the share of variance explained, by sensor; nan if the sensor is constant.
        noise_ratio: by sensor with stated noise, the largest of its columns' errors over it.
        sentence: the verdict in words.
        constant: the columns, by sensor, that never change in any recording.
    """

    good: bool
    failed: tuple[str, ...]
    r_squared: dict[str, float]
    noise_ratio: dict[str, float]
    sentence: str
    constant: dict[str, tuple[str, ...]]


def judged(
    converged: bool, message: str, seen: Traces, recordings: Sequence[Recording],
    coloured: Sequence[str],
) -> Verdict:  # fmt: skip
    """The verdict on a fit: it has converged, the recordings move, it explains 99 % of the variance
    of each sensor, errs by at most 1.5 times the stated noise, and leaves residuals that are
    white."""
    failed = [] if converged else [f"the fit is {message}"]
    shares, ratios = explained_by(seen), noise_ratios(seen, recordings)
    constant = constant_columns(seen)
    if not shares:
        failed.append(f"no sensor has {FEW} samples, which are too few to judge the fit")
    elif np.isnan([*shares.values()]).all():
        failed.append(
            f"nothing moves ({_listed(constant)} constant in all recordings), so the recordings "
            "cannot identify a model of a motion; record one that moves each joint"
        )
    for sensor, share in shares.items():
        if share < EXPLAINED:
            still = " (its values change by no more than its noise)"
            failed.append(
                f"R2 of {sensor} is {share:.3g}, below {EXPLAINED}"
                + (still if _is_still(_traces_of(seen, sensor), recordings, sensor) else "")
            )
    for sensor, ratio in ratios.items():
        if not ratio <= NOISY:
            failed.append(
                f"the error of {sensor} is {ratio:.3g} times its stated noise, above {NOISY}"
            )
    if coloured and not _tiny(seen):
        failed.append(
            f"the residual is not white ({', '.join(coloured)}), so the model lacks something"
        )
    says = "the fit is poor: " + "; ".join(failed) if failed else "the fit is good"
    if not failed:
        worst = float(np.nanmin([*shares.values()]))
        says += f": it explains {100 * worst:.5g} % of the variance, and what remains is noise"
        if constant:
            says += f"; {_listed(constant)} constant, which no model of a motion can explain"
    return Verdict(not failed, tuple(failed), shares, ratios, says, constant)


def _listed(constant: dict[str, tuple[str, ...]]) -> str:
    """Columns that are constant, and the verb."""
    count = sum(map(len, constant.values()))
    words = "; ".join(f"{sensor} of {', '.join(names)}" for sensor, names in constant.items())
    return f"{words} {'is' if count == 1 else 'are'}"


def _traces_of(seen: Traces, sensor: str) -> list[Trace]:
    """The traces of a sensor that have samples enough to judge a motion."""
    return [sensors[sensor] for sensors in seen.values() if sensors[sensor].measured]


def constant_columns(seen: Traces) -> dict[str, tuple[str, ...]]:
    """By sensor, the names of the columns that were recorded and never change."""
    found = {}
    for sensor in next(iter(seen.values())):
        every = _traces_of(seen, sensor)
        if not every:
            continue
        moves = np.any([varies(trace.recorded) for trace in every], 0)
        there = np.any([~np.isnan(trace.recorded).all(0) for trace in every], 0)
        names = tuple(
            n for n, a, b in zip(every[0].names, there, moves, strict=True) if a and not b
        )
        if names:
            found[sensor] = names
    return found


def _is_still(every: Sequence[Trace], recordings: Sequence[Recording], sensor: str) -> bool:
    """Whether all columns of a sensor spread by no more than their noise, which is stated, or as
    large as third differences show."""
    for trace in every:
        noise = roughness(trace.recorded)
        stated = [run[sensor].noise for run in recordings]
        if all(sigma is not None for sigma in stated):
            noise = np.maximum(noise, np.max(stated, 0))
        with warnings.catch_warnings(action="ignore"):  # of columns without samples
            spread = np.nan_to_num(np.nanstd(trace.recorded, 0))
        if (spread > STILL * noise).any():
            return False
    return True


def explained_by(seen: Traces) -> dict[str, float]:
    """By sensor with samples enough, 1 - sum r^2 / sum (y - mean)^2; nan if it is constant."""
    found = {}
    for sensor in next(iter(seen.values())):
        every = _traces_of(seen, sensor)
        if every:
            found[sensor] = explained([t.recorded for t in every], [t.residual for t in every])
    return found


def noise_ratios(seen: Traces, recordings: Sequence[Recording]) -> dict[str, float]:
    """By sensor whose noise is stated, the largest error of a column over its noise."""
    found = {}
    for sensor in explained_by(seen):
        stated = [run[sensor].noise for run in recordings]
        if any(noise is None for noise in stated):
            continue
        columns = next(iter(seen.values()))[sensor].columns
        rms = columns.noise(root_mean_square(together(seen, sensor)))
        noise = np.max([np.broadcast_to(s, rms.shape) for s in stated], 0)
        found[sensor] = float(np.nanmax(rms / noise))
    return found


def is_poor(seen: Traces, recordings: Sequence[Recording], setup: Setup) -> str:
    """Why a fit may be at a wrong minimum, "" if nothing says so: R2 below 0.99, or below 0.999
    with errors above the noise, which is stated or, for joints, as large as third differences of
    the samples show."""
    shares = explained_by(seen)
    for sensor, share in shares.items():
        if share < EXPLAINED:
            return f"R2 of {sensor} {share:.3g}"
    doubted = [sensor for sensor, share in shares.items() if share < CLOSE]
    ratios = noise_ratios(seen, recordings)
    for sensor in doubted:
        if not ratios.get(sensor, 0.0) <= ROUGH:
            return f"error of {sensor} {ratios[sensor]:.3g} times the noise"
    for sensor in doubted:
        if sensor not in ("q", "v") or setup.columns(sensor).turns:
            continue
        error = root_mean_square(together(seen, sensor))
        recorded = np.concatenate([s[sensor].recorded for s in seen.values()])
        rough = np.max([roughness(ordered(setup.model, r)[sensor].values) for r in recordings], 0)
        floor = TINY * np.nanstd(recorded, 0)
        over = np.nanmax(error / np.maximum(ROUGH * rough, np.maximum(floor, 1e-300)))
        if over > 1:
            return f"error of {sensor} {ROUGH * over:.3g} times the roughness of its samples"
    return ""


def roughness(values: np.ndarray) -> np.ndarray:
    """(n,) standard deviation of white noise with such third differences."""
    rough = np.diff(values, n=3, axis=0)
    some = (~np.isnan(rough)).sum(0) > 3
    found = np.full(values.shape[1], np.inf)
    found[some] = np.sqrt(np.nanmean(rough[:, some] ** 2, 0) / 20)
    return found


def _tiny(seen: Traces) -> bool:
    """Whether all residuals are rounding."""
    for sensors in seen.values():
        for sensor, trace in sensors.items():
            if sensor == HELD or not trace.measured:
                continue
            spread = np.nanmax(np.nanstd(trace.recorded, 0))
            if np.nanmax(np.abs(trace.residual)) > TINY * max(spread, 1e-300):
                return False
    return True
