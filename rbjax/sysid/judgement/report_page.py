"""`report`: an HTML page with the estimates, the residuals and the verdicts of a fit."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rbjax.arguments import instance
from rbjax.errors import InputError
from rbjax.html_page import element, listed, page, picture, table
from rbjax.sysid.arguments import recordings_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.data.recording_checks import findings
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.judgement import report_pictures as pictures
from rbjax.sysid.judgement.diagnosis import Diagnosis
from rbjax.sysid.simulation.traces import Trace
from rbjax.sysid.statistics.comparisons import HeldOut
from rbjax.sysid.statistics.residual_tests import Whiteness, whiteness

#: pictures show so many recordings, those with the largest errors
SHOWN = 3
MANY = 60  # parameters of a correlation matrix with names


def report(
    found: Identified,
    path: str | Path = "report.html",
    *,
    held_out: Recording | Sequence[Recording] = (),
    diagnosis: Diagnosis | None = None,
    title: str = "Identification",
) -> Path:
    """Write an HTML page with the fit, its residuals, intervals, correlations and the verdict.

    Args:
        found: the result of `identify`.
        path: of the page.
        held_out: recordings that were not fitted, for the verdict.
        diagnosis: the result of `diagnose`.
        title: of the page.

    Returns:
        The path.

    Raises:
        InputError: a held-out recording that was fitted; a folder that does not exist.

    Example:
        >>> import rbjax as rb, numpy as np, pathlib, tempfile
        >>> from rbjax.sysid import Channel, Recording, Unknown, identify, report
        >>> t = np.arange(40) * 0.01
        >>> run = Recording("fall", {"q": Channel(t, 0.1 * np.cos(3 * t), ["hinge"])})
        >>> mass = {"damping": Unknown("joints.damping", positive=True, bounds=(0.0, 9.0))}
        >>> heavy = rb.load("pendulum")
        >>> heavy = heavy.replace(joints=heavy.joints.replace(damping=np.array([0.1])))
        >>> path = report(identify(heavy, run, mass), pathlib.Path(tempfile.mkdtemp(), "a.html"))
        >>> "Residuals" in path.read_text()
        True
    """
    instance("report", "found", found, Identified, "Identified: the result of `identify`")
    if diagnosis is not None:
        fix = "Diagnosis: the result of `diagnose`"
        instance("report", "diagnosis", diagnosis, Diagnosis, fix)
    if not isinstance(path, (str, Path)):
        raise InputError(f"report: path is {type(path).__name__}, expected a str or a Path")
    path = Path(path)
    if not path.parent.is_dir():
        raise InputError(f"report: path is {path}, but there is no folder {path.parent}; make it")
    unseen = recordings_of("report", held_out, empty=True)
    verdict = found.validate(unseen) if unseen else None
    body = [*_summary(found), *_causes(diagnosis), *_fit(found), *_residuals(found)]
    body += [*_parameters(found), *_identifiable(found)]
    if verdict is not None:
        body += _held_out(found, verdict, unseen)
    body += _data(found)
    lead = _capital(verdict.summary()) if verdict else "No recording was held out to judge the fit."
    footer = "Units are SI: rad, m, kg, N, s. Intervals hold if residuals are white. rbjax"
    path.write_text(page(title, lead, body, footer), encoding="utf-8")
    return path


def _summary(found: Identified) -> list[str]:
    samples = sum(
        int((~np.isnan(trace.recorded)).sum())
        for sensors in found.traces.values()
        for trace in sensors.values()
    )
    words = found.identifiable.summary().splitlines()[0]
    rows = [
        ("recordings", ", ".join(found.traces)),
        ("samples", f"{samples:,}"),
        ("fit", f"{found.status.text}, {found.evaluations} evaluations"),
        ("unknowns", words),
    ]
    for sensor, rms in found.rms.items():
        if any(sensors[sensor].measured for sensors in found.traces.values()):
            rows.append((f"error of {sensor}, RMS", f"{_span(rms)} {found.setup.unit(sensor)}"))
    if found.insensitive_sensors:
        rows.append(("sensors without an unknown", ", ".join(found.insensitive_sensors)))
    if found.unused_channels:
        rows.append(("channels that were not fitted", ", ".join(found.unused_channels)))
    return [element("h2", "Summary"), table(("", ""), rows)]


def _causes(diagnosis: Diagnosis | None) -> list[str]:
    if diagnosis is None:
        return []
    causes = [_capital(line) for line in diagnosis.summary().splitlines()]
    return [element("h2", "Mistakes of the data"), listed(causes)]


def _fit(found: Identified) -> list[str]:
    body = [element("h2", "Fit")]
    for name in _worst(found)[:SHOWN]:
        for sensor, trace in found.traces[name].items():
            if trace.measured:
                caption = f"{name}: {sensor}, recorded (dots) and simulated (line)"
                body.append(picture(pictures.fit(trace, sensor), caption))
    return body


def _residuals(found: Identified) -> list[str]:
    name = _worst(found)[0]
    judged = found.judged_sensor
    trace = found.traces[name][judged]
    body = [
        element("h2", "Residuals"),
        picture(
            pictures.residuals(trace, judged),
            f"{name}: simulated minus recorded {judged}; and its autocorrelation, which is within "
            "the band if the residual is white",
        ),
    ]
    rows = []
    for run, sensors in found.traces.items():
        for column, test in _tests(sensors[judged]).items():
            rms = np.sqrt(np.nanmean(column_of(sensors[judged], column) ** 2))
            rows.append((run, column, f"{rms:.3g}", _capital(test.summary())))
    return [*body, table(("recording", "column", "RMS", "whiteness"), rows)]


def _tests(trace: Trace) -> dict[str, Whiteness]:
    """The tests of the columns that have enough residuals."""
    found = {}
    for name in trace.names:
        r = column_of(trace, name)
        if len(r) >= 10 and np.ptp(r) > 0:
            found[name] = whiteness(r)
    return found


def column_of(trace: Trace, name: str) -> np.ndarray:
    """The residual of a column without the samples that are nan."""
    r = trace.residual[:, trace.names.index(name)] if name in trace.names else np.zeros(0)
    return r[~np.isnan(r)]


def _parameters(found: Identified) -> list[str]:
    rows = []
    for name, value in found.values.items():
        x = found.estimates.interval(name)
        known = np.isfinite(x.sigma)
        rows.append((
            name, f"{found.guess[name]:.5g}", f"{value:.5g}",
            f"{x.low:.5g} to {x.high:.5g}" if known else "not identifiable",
            f"{x.sigma:.2g}" if known else "",
        ))  # fmt: skip
    return [
        element("h2", "Parameters"),
        picture(
            pictures.intervals(found),
            "Estimates with 95 % intervals, and the first guesses (rings)",
        ),
        table(("parameter", "first guess", "estimate", "95 % interval", "sigma"), rows),
    ]


def _identifiable(found: Identified) -> list[str]:
    body = [
        element("h2", "Identifiable combinations"),
        listed(found.identifiable.summary().splitlines()[1:]),
    ]
    if 1 < len(found.values) <= MANY:
        caption = "Correlation of the estimates: pairs near 1 or -1 are hardly distinguishable"
        body.append(picture(pictures.correlation(found), caption))
    return body


def _held_out(found: Identified, verdict: HeldOut, unseen: Sequence[Recording]) -> list[str]:
    worst = max(verdict.by_recording, key=lambda name: verdict.by_recording[name])
    trace = found.simulated([run for run in unseen if run.name == worst])[worst][
        found.judged_sensor
    ]
    return [
        element("h2", "Recordings that were not fitted"),
        element("p", _capital(verdict.summary()) + "."),
        table(("recording", "RMS"), [(n, f"{x:.3g}") for n, x in verdict.by_recording.items()]),
        picture(
            pictures.fit(trace, found.judged_sensor),
            f"{worst}: {found.judged_sensor}, recorded (dots) and simulated (line)",
        ),
    ]


def _data(found: Identified) -> list[str]:
    sentences = [_capital(str(x)) for run in found.recordings for x in findings(run)]
    if not sentences:
        return [element("h2", "Data"), element("p", "No mistakes were found in the recordings.")]
    return [element("h2", "Data"), listed(sentences)]


def _worst(found: Identified) -> list[str]:
    """The recordings, the largest error first."""
    traces = {name: sensors[found.judged_sensor] for name, sensors in found.traces.items()}
    rms = {name: np.nanmean(trace.residual**2) for name, trace in traces.items()}
    return sorted(rms, key=lambda name: -rms[name])


def _span(rms: np.ndarray) -> str:
    low, high = np.nanmin(rms), np.nanmax(rms)
    return f"{high:.3g}" if len(rms) == 1 else f"{low:.3g} to {high:.3g}"


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]
