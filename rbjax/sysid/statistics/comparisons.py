"""Comparison of models: errors on held-out data, and F tests of nested models."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from scipy import stats

from rbjax.arguments import instance, real_array, real_number
from rbjax.display import displayed
from rbjax.errors import InputError
from rbjax.sysid.statistics.residual_tests import ALPHA, explained, whiteness

HOLDS, WEAK = 1.25, 2.0  # largest ratio of the errors on unseen and fitted data
EXPLAINED = 0.99  # least R2 of a good model
NOISY = 1.5  # largest ratio of the error to the noise for a good model
TESTED = 20  # least number of samples of a column for a test of whiteness
ROUNDING = 1e-6  # smaller errors, relative to the standard deviation of the data, are not tested


@displayed
@dataclass(frozen=True, eq=False)
class HeldOut:
    """The errors of a model on data that were not fitted.

    Fields:
        rms: RMS error on unseen data.
        rms_fitted: RMS error on fitted data.
        ratio: rms / rms_fitted.
        by_recording: RMS error on each unseen recording.
        r_squared: explained share of the variance; nan if it is unknown or the data are constant.
        failed: one sentence for each failed check.
        text: the sentence of `summary`.
    """

    rms: float
    rms_fitted: float
    ratio: float
    by_recording: dict[str, float]
    r_squared: float
    failed: tuple[str, ...]
    text: str

    @property
    def success(self) -> bool:
        """Whether all checks pass."""
        return not self.failed

    def summary(self) -> str:
        """Return the verdict as one sentence, with the failed checks."""
        return self.text


def held_out(
    fitted: Mapping[str, Any],
    unseen: Mapping[str, Any],
    *,
    measured: Mapping[str, Any] | None = None,
    noise: float | None = None,
    unit: str = "",
) -> HeldOut:
    """Judge a model by its residuals on recordings that were not fitted.

    The model holds if all these checks pass; checks without data are skipped:
        R2 is at least 99 % (with `measured`).
        The error is at most 1.25 times the error on fitted data.
        The error is at most 1.5 times the noise (with `noise`).
        The residuals are white (columns of 20 samples or more).

    Args:
        fitted: recording -> residuals on fitted data, an array of any shape; NaN is skipped.
        unseen: recording -> residuals on unseen data.
        measured: recording -> measured values, in the shape of the unseen residuals, for R2 = 1 -
            sum r^2 / sum (y - mean)^2.
        noise: standard deviation of the sensor, if it is known.
        unit: unit of the residuals in `summary()`.

    Returns:
        `HeldOut`.

    Raises:
        InputError: no residuals, or a recording that is both fitted and unseen.

    Example:
        >>> import numpy as np
        >>> from rbjax.sysid.statistics import held_out
        >>> print(held_out({"a": [1.0, -1.0]}, {"b": [3.0, -3.0]}, unit="mrad").summary())
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
    if noise is not None:
        real_number("held_out", "noise", noise, "a number above 0, or None", above=0.0)
    instance("held_out", "unit", unit, str, "a str")
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
        p = whiteness_p_value(list(_arrays(unseen)))
        if p is not None and p < ALPHA:
            failed.append(f"the residual is not white (Ljung-Box p = {p:.1g})")
    says = "fails" if not weak else "is weaker" if failed else "holds"
    if still and weak:
        says = "is not tested"
    sentence = f"the model {says}: {sentence}"
    if failed:
        sentence += f"; failed: {'; '.join(failed)}"
    return HeldOut(rms, rms_fitted, float(ratio), each, float(r_squared), tuple(failed), sentence)


def whiteness_p_value(residuals: Sequence[np.ndarray]) -> float | None:
    """Compute the Bonferroni-corrected p value of the Ljung-Box tests of all columns.

    Each array is (samples,) or (samples, columns). Return None if all columns are too short.
    """
    p = []
    for r in residuals:
        for x in r.reshape(len(r), -1).T:
            x = x[~np.isnan(x)]
            if len(x) >= TESTED and np.ptp(x) > 0:
                p.append(whiteness(x).p_value)
    return min(min(p) * len(p), 1.0) if p else None


def _columns(x: np.ndarray) -> np.ndarray:
    return x.reshape(len(x), -1)


def _arrays(given: Mapping[str, Any]) -> Iterator[np.ndarray]:
    for x in given.values():
        yield np.asarray(x, float)


class Scored(NamedTuple):
    """A fitted model and its score.

    Fields:
        name: name of the model.
        squares: weighted sum of the squared residuals, no unit.
        parameters: number of parameters.
    """

    name: str
    squares: float
    parameters: int


@displayed
@dataclass(frozen=True, eq=False)
class Comparison:
    """The comparison of two nested models on the same data.

    Fields:
        smaller: name of the smaller model.
        larger: name of the larger model.
        F: statistic of the F test.
        p_value: p value of the F test.
        aic: AIC of the larger model minus AIC of the smaller model.
        bic: BIC of the larger model minus BIC of the smaller model.
    """

    smaller: str
    larger: str
    F: float
    p_value: float
    aic: float
    bic: float

    @property
    def significant(self) -> bool:
        """Whether the data support the larger model: p is below 1 %, and its BIC is smaller."""
        return self.p_value < ALPHA and self.bic < 0

    def summary(self) -> str:
        """Return the result as one sentence."""
        needed = "is needed" if self.significant else "is not needed"
        change = "falls" if self.bic < 0 else "grows"
        return (
            f"{self.larger} {needed} in place of {self.smaller}: F = {self.F:.3g}, "
            f"p = {self.p_value:.1g}, BIC {change} by {abs(self.bic):.0f}"
        )


def compare(smaller: Scored, larger: Scored, samples: float) -> Comparison:
    """Test whether data support the additional terms of a larger model.

        F = ((Q_0 - Q_1) / (p_1 - p_0)) / (Q_1 / (n - p_1))
        AIC = n log(Q/n) + 2 p        BIC = n log(Q/n) + p log n

    Q is the sum of squared residuals and p the number of parameters.

    Args:
        smaller: model without the additional terms.
        larger: model with the additional terms, of which `smaller` is a special case.
        samples: n. If residuals are not white, use `Whiteness.effective_samples`.

    Returns:
        `Comparison`.

    Raises:
        InputError: models that are not nested (`larger` has no more parameters or fits worse), or
            fewer samples than parameters.

    Source: Seber & Wild, *Nonlinear Regression*, 5.3; Akaike 1974; Schwarz 1978.

    Example:
        >>> from rbjax.sysid.statistics import Scored, compare
        >>> plain, rubbed = Scored("viscous", 10.0, 3), Scored("viscous + Coulomb", 4.0, 4)
        >>> print(compare(plain, rubbed, 100).summary())
        viscous + Coulomb is needed in place of viscous: F = 144, p = 8e-21, BIC falls by 87
    """
    for name, model in (("smaller", smaller), ("larger", larger)):
        instance("compare", name, model, Scored, "Scored(name, squares, parameters)")
        real_number("compare", f"squares of {name}", model.squares)
        real_number("compare", f"parameters of {name}", model.parameters)
    real_number("compare", "samples", samples)
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
    return Comparison(smaller.name, larger.name, float(F), p, aic, bic)


def _checked(name: str, given: Any) -> dict[str, np.ndarray]:
    instance("held_out", name, given, Mapping, "a dict recording -> residuals")
    return {
        run: np.atleast_1d(real_array("held_out", f"{name}[{run!r}]", x, finite=False))
        for run, x in given.items()
    }


def _rms(residuals: Any) -> float:
    together = np.concatenate([np.asarray(r, float).ravel() for r in residuals])
    together = together[~np.isnan(together)]
    if not together.size:
        raise InputError("held_out: no residuals, expected numbers")
    return float(np.sqrt(np.mean(together**2)))
