"""Which model the data need: scores on data that no fit saw, and tests of one term more."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from rbjax.errors import InputError
from rbjax.sysid.arguments import floats
from rbjax.sysid.statistics.variance import explained
from rbjax.sysid.statistics.whiteness_tests import whiteness

HOLDS, WEAK = 1.25, 2.0  # error on unseen data over that on fitted data
EXPLAINED = 0.99  # the least share of variance that a good model explains
NOISY = 1.5  # the largest error of a good model, over the noise
TESTED = 20  # the least number of samples of a column for a test of whiteness
ROUNDING = 1e-6  # an error below this share of the spread is not tested for whiteness
ALPHA = 0.01  # a p value below it is significant


@dataclass(frozen=True, eq=False)
class HeldOut:
    """A model on data that the fit never saw.

    Fields: rms on unseen and rms_fitted on fitted data; ratio of the two; by_recording, the rms of
    each unseen one; r_squared, the share of variance explained, nan if unknown or if nothing
    varies; holds, whether all checks pass; failed, a sentence for each check that does not;
    sentence.
    """

    rms: float
    rms_fitted: float
    ratio: float
    by_recording: dict[str, float]
    r_squared: float
    holds: bool
    sentence: str
    failed: tuple[str, ...] = ()


def held_out(
    fitted: Mapping[str, Any],
    unseen: Mapping[str, Any],
    *,
    measured: Mapping[str, Any] | None = None,
    noise: float | None = None,
    unit: str = "",
) -> HeldOut:
    """The verdict on a model from its residuals on recordings that were not fitted.

    The model holds if it explains 99 % of the variance (with `measured`), and its error is at most
    1.25 times the error on fitted data, at most 1.5 times the noise (with `noise`), and white
    (columns of 20 samples or more). Checks for which data are missing are left out.

    Args:
        fitted: recording -> residuals, an array of any shape; nan is left out.
        unseen: recording -> residuals.
        measured: recording -> (samples,) or (samples, columns), what the unseen residuals belong
            to, for the share of variance that is explained: 1 - sum r^2 / sum (y - mean)^2.
        noise: standard deviation of the sensor, if it is known.
        unit: of the residuals, for the sentence.

    Returns:
        `HeldOut`.

    Raises:
        InputError: no residuals; a recording on both sides.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.statistics import held_out
        >>> print(held_out({"a": [1.0, -1.0]}, {"b": [3.0, -3.0]}, unit="mrad").sentence)
        the model fails: on 1 recording outside of the fit its error is 3 mrad RMS, 3 times the
        error on fitted data; failed: the error is 3 times the error on fitted data, above 1.25
    """
    fitted, unseen = _checked("fitted", fitted), _checked("unseen", unseen)
    if measured is not None:
        measured = _checked("measured", measured)
        wrong = [n for n in unseen if n not in measured or measured[n].shape != unseen[n].shape]
        if wrong:
            raise InputError(
                f"held_out: measured of {wrong[0]} is missing or of another shape than its "
                "residuals, expected one value for each"
            )
    if noise is not None and not (_is_number(noise) and noise > 0):
        raise InputError(f"held_out: noise is {noise!r}, expected a number above 0, or None")
    if not isinstance(unit, str):
        raise InputError(f"held_out: unit is {unit!r}, expected a str")
    both = sorted(set(fitted) & set(unseen))
    if both or not fitted or not unseen:
        raise InputError(
            f"held_out: {len(fitted)} fitted and {len(unseen)} unseen recordings, on both sides: "
            f"{', '.join(both) or 'none'}; expected some on each side, none on both"
        )
    rms_fitted, rms = _rms(fitted.values()), _rms(unseen.values())
    each = {name: _rms([r]) for name, r in unseen.items()}
    ratio = rms / rms_fitted if rms_fitted > 0 else (np.inf if rms > 0 else 1.0)
    unit = f" {unit}" if unit else ""
    plural = "recording" if len(unseen) == 1 else "recordings"
    sentence = (
        f"on {len(unseen)} {plural} outside of the fit its error is "
        f"{rms:.3g}{unit} RMS, {ratio:.3g} times the error on fitted data"
    )
    worst = max(each, key=lambda name: each[name])
    if len(each) > 1:
        sentence += f" (the worst, {worst}: {each[worst]:.3g}{unit})"
    r_squared, failed, still = np.nan, [], False
    if not ratio <= HOLDS:
        failed.append(f"the error is {ratio:.3g} times the error on fitted data, above {HOLDS}")
    weak = ratio <= WEAK
    if measured is not None:
        parts = [(np.asarray(unseen[n], float), np.asarray(measured[n], float)) for n in unseen]
        r_squared = explained(*([_columns(part[k]) for part in parts] for k in (1, 0)))
        still = np.isnan(r_squared)
        if still:
            failed.append("the recordings are constant, so that they cannot test a motion")
        else:
            sentence += f"; it explains {100 * r_squared:.3g} % of the variance"
        if r_squared < EXPLAINED:
            failed.append(f"R2 is {r_squared:.4g}, below {EXPLAINED}")
            weak = False
    if noise is not None:
        sentence += f"; the error is {rms / noise:.3g} times the noise"
        if rms > NOISY * noise:
            failed.append(f"the error is {rms / noise:.3g} times the noise, above {NOISY}")
        if rms > 3 * noise:
            sentence += ", so the model lacks something"
            weak = False
    spread = None if measured is None else _rms([y - np.nanmean(y, 0) for y in _arrays(measured)])
    if spread is None or rms > ROUNDING * spread:
        test = colour(list(_arrays(unseen)))
        if test is not None and not test[0]:
            failed.append(f"the residual is not white (Ljung-Box p = {test[1]:.1g})")
    says = "fails" if not weak else "is weaker" if failed else "holds"
    if still and weak:
        says = "is not tested"
    sentence = f"the model {says}: {sentence}"
    if failed:
        sentence += f"; failed: {'; '.join(failed)}"
    return HeldOut(
        rms, rms_fitted, float(ratio), each, float(r_squared), not failed, sentence, tuple(failed)
    )


def colour(residuals: Sequence[np.ndarray]) -> tuple[bool, float] | None:
    """Whether residuals, (samples,) or (samples, columns) each, are white, and the p value:
    Bonferroni's bound of the Ljung-Box tests of all columns. None if all are too short to test."""
    p = []
    for r in residuals:
        for x in r.reshape(len(r), -1).T:
            x = x[~np.isnan(x)]
            if len(x) >= TESTED and np.ptp(x) > 0:
                p.append(whiteness(x).p_value)
    if not p:
        return None
    found = min(min(p) * len(p), 1.0)
    return found >= ALPHA, found


def _columns(x: np.ndarray) -> np.ndarray:
    return x.reshape(len(x), -1)


def _arrays(given: Mapping[str, Any]) -> Iterator[np.ndarray]:
    for x in given.values():
        yield np.asarray(x, float)


class Scored(NamedTuple):
    """A fitted model: name, weighted sum of squared residuals, number of parameters."""

    name: str
    squares: float
    parameters: int


@dataclass(frozen=True, eq=False)
class Comparison:
    """Two nested models on the same data.

    Fields: F and p_value, of the F test; aic and bic, those of the larger model less those of the
    smaller; earned, whether the larger one is needed; sentence.
    """

    F: float
    p_value: float
    aic: float
    bic: float
    earned: bool
    sentence: str


def compare(smaller: Scored, larger: Scored, samples: float) -> Comparison:
    """Whether the terms that a larger model has more earn their place.

        F = ((Q_0 - Q_1) / (p_1 - p_0)) / (Q_1 / (n - p_1))
        AIC = n log(Q/n) + 2 p        BIC = n log(Q/n) + p log n
    They do if chance gives such an F in less than 1 % of cases, and BIC falls.

    Args:
        smaller: the model without the terms.
        larger: the model with them; the smaller one is a case of it.
        samples: n. If residuals are not white, the effective number: `whiteness` gives it.

    Returns:
        `Comparison`.

    Raises:
        InputError: models that are not nested: a larger one with no more parameters, or that fits
            worse; fewer samples than parameters.

    Source: Seber & Wild, *Nonlinear Regression*, 5.3; Akaike 1974; Schwarz 1978.

    Example:
        >>> from rbjax.sysid.statistics import Scored, compare
        >>> plain, rubbed = Scored("viscous", 10.0, 3), Scored("viscous + Coulomb", 4.0, 4)
        >>> print(compare(plain, rubbed, 100).sentence)
        viscous + Coulomb earns its place beside viscous: F = 144, p = 8e-21, BIC falls by 87
    """
    for name, model in (("smaller", smaller), ("larger", larger)):
        fine = isinstance(model, Scored) and all(_is_number(x) for x in model[1:])
        if not fine:
            raise InputError(
                f"compare: {name} is {model!r}, expected Scored(name, squares, parameters) with "
                "finite numbers"
            )
    if not _is_number(samples):
        raise InputError(f"compare: samples is {samples!r}, expected a finite number")
    more = larger.parameters - smaller.parameters
    left = samples - larger.parameters
    if more < 1 or left <= 0:
        raise InputError(
            f"compare: {smaller.name} has {smaller.parameters} parameters and {larger.name} "
            f"{larger.parameters}, with {samples:g} samples; expected more in the second, and "
            "more samples than parameters"
        )
    if not 0 <= larger.squares <= smaller.squares * (1 + 1e-9) or smaller.squares <= 0:
        raise InputError(
            f"compare: {larger.name} leaves {larger.squares:g} and {smaller.name} "
            f"{smaller.squares:g}, expected no more in the larger model; one of the two fits has "
            "not converged, or they are not nested"
        )
    gain = max(smaller.squares - larger.squares, 0.0)
    rest = max(larger.squares, 1e-300)
    F = (gain / more) / (rest / left)
    p = float(stats.f.sf(F, more, left))
    fall = samples * np.log(smaller.squares / rest)
    aic, bic = float(2 * more - fall), float(more * np.log(samples) - fall)
    earned = p < ALPHA and bic < 0
    sentence = (
        f"{larger.name} {'earns' if earned else 'does not earn'} its place beside {smaller.name}: "
        f"F = {F:.3g}, p = {p:.1g}, BIC {'falls' if bic < 0 else 'grows'} by {abs(bic):.0f}"
    )
    return Comparison(float(F), p, aic, bic, earned, sentence)


def _is_number(x: Any) -> bool:
    return (
        isinstance(x, (int, float, np.number)) and not isinstance(x, bool) and bool(np.isfinite(x))
    )


def _checked(name: str, given: Any) -> dict[str, np.ndarray]:
    if not isinstance(given, Mapping):
        raise InputError(
            f"held_out: {name} is {type(given).__name__}, expected a dict recording -> residuals"
        )
    return {
        run: np.atleast_1d(floats("held_out", f"{name}[{run!r}]", x)) for run, x in given.items()
    }


def _rms(residuals: Any) -> float:
    together = np.concatenate([np.asarray(r, float).ravel() for r in residuals])
    together = together[~np.isnan(together)]
    if not together.size:
        raise InputError("held_out: no residuals, expected numbers")
    return float(np.sqrt(np.mean(together**2)))
