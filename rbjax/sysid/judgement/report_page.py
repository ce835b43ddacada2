"""`report`: an HTML page with the estimates, the residuals and the verdict of a fit."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rbjax.arguments import instance
from rbjax.errors import InputError
from rbjax.html_page import element, listed, page, picture, table
from rbjax.optional import require
from rbjax.style import BLUE, INK, ORANGE, RED, STYLE
from rbjax.sysid.arguments import recordings_of
from rbjax.sysid.data.recording import Recording
from rbjax.sysid.data.recording_checks import findings
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.judgement.corrections import Diagnosis
from rbjax.sysid.simulation.traces import Trace
from rbjax.sysid.statistics.comparisons import HeldOut
from rbjax.sysid.statistics.residual_tests import Whiteness, whiteness

Axes = Any
SHOWN = 3  # number of recordings with pictures, the largest errors first
COLUMNS = 12  # largest number of columns of a sensor in a picture
POINTS = 1500  # largest number of dots of a recording
MANY = 60  # largest number of parameters in the picture of the correlations


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
        found: result of `identify`.
        path: path of the page.
        held_out: recordings that were not fitted, for the verdict.
        diagnosis: result of `diagnose`.
        title: title of the page.

    Returns:
        The path of the page.

    Raises:
        InputError: a held-out recording that was fitted, or a folder that does not exist.

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
    instance("report", "path", path, (str, Path), "a str or a Path")
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
                body.append(picture(draw_fit(trace, sensor), caption))
    return body


def _residuals(found: Identified) -> list[str]:
    name = _worst(found)[0]
    judged = found.judged_sensor
    trace = found.traces[name][judged]
    body = [
        element("h2", "Residuals"),
        picture(
            draw_residuals(trace, judged),
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
    """Test the whiteness of each column with enough residuals."""
    found = {}
    for name in trace.names:
        r = column_of(trace, name)
        if len(r) >= 10 and np.ptp(r) > 0:
            found[name] = whiteness(r)
    return found


def column_of(trace: Trace, name: str) -> np.ndarray:
    """Select the residual of a column, without NaN."""
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
            draw_intervals(found), "Estimates with 95 % intervals, and the first guesses (rings)"
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
        body.append(picture(draw_correlation(found), caption))
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
            draw_fit(trace, found.judged_sensor),
            f"{worst}: {found.judged_sensor}, recorded (dots) and simulated (line)",
        ),
    ]


def _data(found: Identified) -> list[str]:
    sentences = [_capital(str(x)) for run in found.recordings for x in findings(run)]
    if not sentences:
        return [element("h2", "Data"), element("p", "No mistakes were found in the recordings.")]
    return [element("h2", "Data"), listed(sentences)]


def _worst(found: Identified) -> list[str]:
    """Sort the names of the recordings by error, the largest first."""
    traces = {name: sensors[found.judged_sensor] for name, sensors in found.traces.items()}
    rms = {name: np.nanmean(trace.residual**2) for name, trace in traces.items()}
    return sorted(rms, key=lambda name: -rms[name])


def _span(rms: np.ndarray) -> str:
    low, high = np.nanmin(rms), np.nanmax(rms)
    return f"{high:.3g}" if len(rms) == 1 else f"{low:.3g} to {high:.3g}"


def _capital(sentence: str) -> str:
    return sentence[:1].upper() + sentence[1:]


def _styled(draw: Callable[..., bytes]) -> Callable[..., bytes]:
    """Decorate a function that draws a picture, to use the matplotlib style of rbjax."""

    @functools.wraps(draw)
    def drawn(*args: Any) -> bytes:
        with require("report", "matplotlib").rc_context(STYLE):
            return draw(*args)

    return drawn


@_styled
def draw_fit(trace: Trace, sensor: str) -> bytes:
    """Draw recorded and simulated values, one panel for each column."""

    def draw(ax: Axes, k: int) -> None:
        some = slice(None, None, max(1, len(trace.t) // POINTS))
        ax.plot(trace.t[some], trace.recorded[some, k], ".", ms=3.5, color=ORANGE, alpha=0.7)
        ax.plot(trace.t, trace.simulated[:, k], color=BLUE, lw=1.1)
        ax.set_title(trace.names[k])

    return _panels(len(trace.names), draw, f"{sensor}")


@_styled
def draw_residuals(trace: Trace, sensor: str) -> bytes:
    """Draw each residual over time and its autocorrelation, one row for each column."""
    n = min(len(trace.names), COLUMNS // 2)
    figure, axes = _figure(n, 2, 1.5 * n + 0.6, widths=(2.6, 1))
    for k, (left, right) in enumerate(axes):
        r = trace.residual[:, k]
        known = ~np.isnan(r)
        left.plot(trace.t[known], r[known], lw=0.6, color=BLUE)
        left.set_title(f"{trace.names[k]}, {sensor}")
        if known.sum() < 10 or np.ptp(r[known]) == 0:
            continue
        rho = whiteness(r[known]).correlation
        band = 1.96 / np.sqrt(known.sum())
        right.axhspan(-band, band, color=BLUE, alpha=0.15, lw=0)
        right.vlines(np.arange(1, len(rho) + 1), 0, rho, color=INK, lw=1.6)
        right.set_ylim(min(-0.3, rho.min() * 1.1), max(0.3, min(1.05, rho.max() * 1.2)))
    axes[-1][0].set_xlabel("time [s]")
    axes[-1][1].set_xlabel("lag [samples]")
    return _png(figure)


@_styled
def draw_intervals(found: Identified) -> bytes:
    """Draw estimates, intervals and first guesses, one panel for each group of unknowns."""
    groups: dict[str, list[str]] = {}
    for name in found.values:
        groups.setdefault(name.split("[")[0].split(".")[0], []).append(name)
    shown = list(groups.items())[:COLUMNS]

    def draw(ax: Axes, k: int) -> None:
        label, names = shown[k]
        for at, name in enumerate(names):
            x = found.estimates.interval(name)
            if np.isfinite(x.sigma):
                ax.vlines(at, x.low, x.high, color=BLUE, lw=2.2, alpha=0.5)
            ax.plot(at, found.values[name], "o", ms=5, color=BLUE if np.isfinite(x.sigma) else RED)
            ax.plot(at, found.guess[name], "o", ms=7, mfc="none", mec=ORANGE, mew=1.3)
        ticks = [n.removeprefix(label).strip(".[]") for n in names]
        ax.set_xticks(range(len(names)), ticks, rotation=0 if len(names) < 8 else 60, fontsize=8)
        ax.set_xlim(-0.6, len(names) - 0.4)
        ax.margins(y=0.15)
        ax.grid(axis="x", visible=False)
        ax.set_title(label)

    return _panels(len(shown), draw, "", shared=False)


@_styled
def draw_correlation(found: Identified) -> bytes:
    """Draw the correlation matrix of the estimates, without initial states."""
    n = len(found.values)
    figure, axes = _figure(1, 1, min(7.5, 2.5 + 0.16 * n), width=min(8.5, 3.5 + 0.16 * n))
    ax = axes[0][0]
    image = ax.imshow(found.estimates.correlation[:n, :n], cmap="RdBu_r", vmin=-1, vmax=1)
    small = 8 if n <= 25 else 5.5
    ax.set_xticks(range(n), list(found.values), rotation=90, fontsize=small)
    ax.set_yticks(range(n), list(found.values), fontsize=small)
    ax.grid(visible=False)
    figure.colorbar(image, shrink=0.8)
    return _png(figure)


def _panels(count: int, draw: Any, label: str, shared: bool = True) -> bytes:
    """Draw `count` panels, up to three in a row."""
    count = min(count, COLUMNS)
    across = min(count, 3)
    down = -(-count // across)
    figure, axes = _figure(down, across, 2.2 * down + 0.4)
    flat = [ax for row in axes for ax in row]
    for k, ax in enumerate(flat):
        if k >= count:
            ax.set_visible(False)
            continue
        draw(ax, k)
        if shared and k >= count - across:
            ax.set_xlabel("time [s]")
        if label and k % across == 0:
            ax.set_ylabel(label)
    return _png(figure)


def _figure(
    down: int, across: int, height: float, *, width: float = 9.5, widths: Any = None
) -> tuple[Any, list[list[Axes]]]:
    Figure = require("report", "matplotlib.figure").Figure
    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    axes = figure.subplots(down, across, squeeze=False, width_ratios=widths)
    return figure, [list(row) for row in axes]


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return file.getvalue()
