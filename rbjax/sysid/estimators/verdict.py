"""The verdict on a fit, from the recordings that were fitted."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rbjax.sensors.columns import root_mean_square
from rbjax.status import Status
from rbjax.sysid.data.recording import HELD, Recording
from rbjax.sysid.simulation.runs import order_columns
from rbjax.sysid.simulation.setup import Setup
from rbjax.sysid.simulation.traces import FEW, Trace, Traces, residuals_of
from rbjax.sysid.statistics.comparisons import EXPLAINED, NOISY
from rbjax.sysid.statistics.residual_tests import explained, varies

#: residuals above this multiple of the roughness of the recordings are not noise
ROUGH = 3.0
#: a fit with a larger R2 is assumed to be at the right minimum
CLOSE = 0.999
#: residuals below this share of the standard deviation are rounding or integration errors
TINY = 1e-5
#: least size of an outlier in robust standard deviations; 1 in 16,000 of normal noise
OUTLIER = 4.0
#: largest share of outliers of a good model
MOST = 0.2
#: ratio of the standard deviation of normal noise to the median of its absolute value
NORMAL = 1.4826
#: a sensor with a smaller ratio of standard deviation to noise has no motion
STILL = 2.0


@dataclass(frozen=True)
class Verdict:
    """The verdict on a fit.

    Fields:
        failed: one sentence for each failed check; empty if the fit is good.
        r_squared: sensor -> explained share of the variance; nan if it is constant.
        noise_ratio: sensor with stated noise -> ratio of the error of the worst column to the
            noise.
        constant: sensor -> columns that are constant in all recordings.
        outliers: sensor -> share of outliers, with loss="huber". The other fields exclude outliers.
    """

    failed: tuple[str, ...]
    r_squared: dict[str, float]
    noise_ratio: dict[str, float]
    constant: dict[str, tuple[str, ...]]
    outliers: dict[str, float]

    @property
    def success(self) -> bool:
        """Whether all checks pass."""
        return not self.failed

    def summary(self) -> str:
        """Return the verdict as one sentence, with the failed checks."""
        if self.failed:
            return "the fit is poor: " + "; ".join(self.failed)
        worst = float(np.nanmin([*self.r_squared.values()]))
        text = f"the fit is good: it explains {100 * worst:.5g} % of the variance, and what "
        text += "remains is noise"
        if self.constant:
            text += (
                f"; {_list_columns(self.constant)} constant, which no model of a motion can explain"
            )
        if any(self.outliers.values()):
            parts = [f"{100 * x:.2g} % of {sensor}" for sensor, x in self.outliers.items() if x]
            text += f"; outliers do not count ({', '.join(parts)})"
        return text


def judge(
    status: Status, seen: Traces, recordings: Sequence[Recording], coloured: Sequence[str], *,
    robust: bool = False,
) -> Verdict:  # fmt: skip
    """Judge a fit by its convergence, R2, errors relative to the noise, and whiteness.

    A good fit has converged, explains 99 % of the variance of each sensor, has errors of at most
    1.5 times the stated noise, and white residuals. `coloured` are the columns with residuals that
    are not white. With `robust`, outliers are ignored, but may be at most a fifth of the samples.
    """
    failed = [] if status == Status.CONVERGED else [f"the fit is {status.text}"]
    seen, outliers = without_outliers(seen) if robust else (seen, {})
    for sensor, share in outliers.items():
        if share > MOST:
            failed.append(
                f"{100 * share:.3g} % of the residuals of {sensor} are outliers, above "
                f"{100 * MOST:.3g} %"
            )
    shares, ratios = explained_by(seen), noise_ratios(seen, recordings)
    constant = constant_columns(seen)
    if not shares:
        failed.append(f"no sensor has {FEW} samples, which are too few to judge the fit")
    elif np.isnan([*shares.values()]).all():
        failed.append(
            f"nothing moves ({_list_columns(constant)} constant in all recordings), so they "
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
            f"the residual is not white ({', '.join(coloured)}), so the model lacks something, and "
            "intervals may miss the truth"
        )
    return Verdict(tuple(failed), shares, ratios, constant, outliers)


def _list_columns(constant: dict[str, tuple[str, ...]]) -> str:
    """Format columns by sensor, followed by "is" or "are"."""
    count = sum(map(len, constant.values()))
    words = "; ".join(f"{sensor} of {', '.join(names)}" for sensor, names in constant.items())
    return f"{words} {'is' if count == 1 else 'are'}"


def _traces_of(seen: Traces, sensor: str) -> list[Trace]:
    """Return the traces of a sensor with enough samples."""
    return [sensors[sensor] for sensors in seen.values() if sensors[sensor].measured]


def constant_columns(seen: Traces) -> dict[str, tuple[str, ...]]:
    """Find the columns that are constant in all recordings, by sensor."""
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
    """Check that no column of a sensor varies by much more than its noise.

    The noise is the larger of the stated noise and an estimate from third differences.
    """
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


def without_outliers(seen: Traces) -> tuple[Traces, dict[str, float]]:
    """Remove the samples with outlying residuals, relative to the median of their column.

    Also return the share of these samples by sensor.
    """
    found: dict[str, dict[str, Trace]] = {name: dict(sensors) for name, sensors in seen.items()}
    shares = {}
    for sensor in next(iter(seen.values())):
        if not _traces_of(seen, sensor):
            continue
        with warnings.catch_warnings(action="ignore"):  # of columns without samples
            scale = NORMAL * np.nanmedian(np.abs(residuals_of(seen, sensor)), 0)
        out, count = 0, 0
        for name, sensors in seen.items():
            trace = sensors[sensor]
            far = np.abs(trace.residual) > OUTLIER * scale
            for k in trace.turns:  # an attitude is an outlier as a whole
                far[:, k : k + 4] = far[:, k : k + 4].any(1, keepdims=True)
            out += int(far.sum())
            count += int((~np.isnan(trace.recorded)).sum())
            found[name][sensor] = trace._replace(recorded=np.where(far, np.nan, trace.recorded))
        shares[sensor] = out / max(count, 1)
    return found, shares


def explained_by(seen: Traces) -> dict[str, float]:
    """Compute R2 of each sensor with enough samples; nan if the sensor is constant."""
    found = {}
    for sensor in next(iter(seen.values())):
        every = _traces_of(seen, sensor)
        if every:
            found[sensor] = explained([t.recorded for t in every], [t.residual for t in every])
    return found


def noise_ratios(seen: Traces, recordings: Sequence[Recording]) -> dict[str, float]:
    """Compute the ratio of the worst column's error to the noise, by sensor with stated noise."""
    found = {}
    for sensor in explained_by(seen):
        stated = [run[sensor].noise for run in recordings]
        if any(noise is None for noise in stated):
            continue
        columns = next(iter(seen.values()))[sensor].columns
        rms = columns.noise(root_mean_square(residuals_of(seen, sensor)))
        noise = np.max([np.broadcast_to(s, rms.shape) for s in stated], 0)
        found[sensor] = float(np.nanmax(rms / noise))
    return found


def is_poor(
    seen: Traces, recordings: Sequence[Recording], setup: Setup, *, robust: bool = False
) -> str:
    """Return the reason why a fit may be at a wrong minimum, or "" if it is good.

    A fit is poor if R2 is below 0.99, or below 0.999 with errors above the noise. The noise is
    stated or, for joints, estimated from third differences. With `robust`, outliers are ignored.
    """
    if robust:
        seen, outliers = without_outliers(seen)
        for sensor, share in outliers.items():
            if share > MOST:
                return f"{100 * share:.3g} % of the residuals of {sensor} are outliers"
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
        error = root_mean_square(residuals_of(seen, sensor))
        recorded = np.concatenate([s[sensor].recorded for s in seen.values()])
        rough = np.max(
            [roughness(order_columns(setup.model, r)[sensor].values) for r in recordings], 0
        )
        floor = TINY * np.nanstd(recorded, 0)
        over = np.nanmax(error / np.maximum(ROUGH * rough, np.maximum(floor, 1e-300)))
        if over > 1:
            return f"error of {sensor} {ROUGH * over:.3g} times the roughness of its samples"
    return ""


def roughness(values: np.ndarray) -> np.ndarray:
    """Estimate the standard deviation (n,) of white noise from third differences."""
    rough = np.diff(values, n=3, axis=0)
    some = (~np.isnan(rough)).sum(0) > 3
    found = np.full(values.shape[1], np.inf)
    found[some] = np.sqrt(np.nanmean(rough[:, some] ** 2, 0) / 20)
    return found


def _tiny(seen: Traces) -> bool:
    """Check that all residuals are rounding or integration errors."""
    for sensors in seen.values():
        for sensor, trace in sensors.items():
            if sensor == HELD or not trace.measured:
                continue
            spread = np.nanmax(np.nanstd(trace.recorded, 0))
            if np.nanmax(np.abs(trace.residual)) > TINY * max(spread, 1e-300):
                return False
    return True
