"""`Verdict`: whether a fit is good, from the data that it was fitted to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbjax.sysid.columns import root_mean_square
from rbjax.sysid.comparison import EXPLAINED, NOISY
from rbjax.sysid.recording import HELD, Recording
from rbjax.sysid.runs import ordered
from rbjax.sysid.simulation import Setup
from rbjax.sysid.traces import Traces, together

#: residuals above this many times the roughness of the recordings are not noise
ROUGH = 3.0
#: a fit that explains more than this share of the variance counts as being at the right minimum
CLOSE = 0.999
#: residuals below this share of the spread are rounding, or the error of integration
TINY = 1e-5


@dataclass(frozen=True)
class Verdict:
    """Whether a fit is good.

    Fields: good, whether all checks pass; failed, a sentence for each check that does not;
    r_squared, the share of variance explained, by sensor; noise_ratio, by sensor with stated noise
    the largest of its columns' errors over that noise; sentence.
    """

    good: bool
    failed: tuple[str, ...]
    r_squared: dict[str, float]
    noise_ratio: dict[str, float]
    sentence: str


def judged(
    converged: bool, message: str, seen: Traces, recordings: Sequence[Recording],
    coloured: Sequence[str],
) -> Verdict:  # fmt: skip
    """The verdict on a fit: it has converged, explains 99 % of the variance of each sensor, errs by
    at most 1.5 times the stated noise, and leaves residuals that are white."""
    failed = [] if converged else [f"the fit is {message}"]
    explained, ratios = explained_by(seen), noise_ratios(seen, recordings)
    for sensor, share in explained.items():
        if not share >= EXPLAINED:
            failed.append(f"R2 of {sensor} is {share:.3g}, below {EXPLAINED}")
    for sensor, ratio in ratios.items():
        if not ratio <= NOISY:
            failed.append(
                f"the error of {sensor} is {ratio:.3g} times its stated noise, above {NOISY}"
            )
    if coloured and not _tiny(seen):
        failed.append(
            f"the residual is not white ({', '.join(coloured)}), so the model lacks something"
        )
    worst = min(explained.values(), default=np.nan)
    says = "the fit is poor: " + "; ".join(failed) if failed else "the fit is good"
    if not failed and np.isfinite(worst):
        says += f": it explains {100 * worst:.5g} % of the variance, and what remains is noise"
    return Verdict(not failed, tuple(failed), explained, ratios, says)


def explained_by(seen: Traces) -> dict[str, float]:
    """By sensor with samples enough, 1 - sum r^2 / sum (y - mean)^2."""
    found = {}
    for sensor in next(iter(seen.values())):
        if not all(sensors[sensor].measured for sensors in seen.values()):
            continue
        left = there = 0.0
        for sensors in seen.values():
            y = sensors[sensor].recorded
            left += float(np.nansum(sensors[sensor].residual ** 2))
            columns = ~np.isnan(y).all(0)
            there += float(np.nansum((y[:, columns] - np.nanmean(y[:, columns], 0)) ** 2))
        if there > 0:
            found[sensor] = 1 - left / there
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
    explained = explained_by(seen)
    for sensor, share in explained.items():
        if not share >= EXPLAINED:
            return f"R2 of {sensor} {share:.3g}"
    doubted = [sensor for sensor, share in explained.items() if share < CLOSE]
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
    """(n,) standard deviation of white noise, estimated from third differences."""
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
