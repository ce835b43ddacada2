"""The pictures of a report, as PNG."""

from __future__ import annotations

import functools
import io
from collections.abc import Callable
from typing import Any

import numpy as np

from rbjax.style import BLUE, INK, ORANGE, RED, STYLE
from rbjax.sysid.estimators.identified import Identified
from rbjax.sysid.simulation.traces import Trace
from rbjax.sysid.statistics.residual_tests import whiteness

COLUMNS = 12  # of a sensor that are shown
POINTS = 1500  # dots of a recording
Axes = Any


def _styled(draw: Callable[..., bytes]) -> Callable[..., bytes]:
    """Draw a picture in the style of rbjax."""

    @functools.wraps(draw)
    def drawn(*args: Any) -> bytes:
        from matplotlib import rc_context

        with rc_context(STYLE):
            return draw(*args)

    return drawn


@_styled
def fit(trace: Trace, sensor: str) -> bytes:
    """Draw recorded and simulated values, a panel for each column."""

    def draw(ax: Axes, k: int) -> None:
        some = slice(None, None, max(1, len(trace.t) // POINTS))
        ax.plot(trace.t[some], trace.recorded[some, k], ".", ms=3.5, color=ORANGE, alpha=0.7)
        ax.plot(trace.t, trace.simulated[:, k], color=BLUE, lw=1.1)
        ax.set_title(trace.names[k])

    return _panels(len(trace.names), draw, f"{sensor}")


@_styled
def residuals(trace: Trace, sensor: str) -> bytes:
    """Draw the residual over time and its autocorrelation, a row for each column."""
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
def intervals(found: Identified) -> bytes:
    """Draw estimates with intervals and first guesses, a panel for each unknown."""
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
def correlation(found: Identified) -> bytes:
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
    """Draw small panels, up to three in a row."""
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
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), layout="constrained", dpi=110)
    axes = figure.subplots(down, across, squeeze=False, width_ratios=widths)
    return figure, [list(row) for row in axes]


def _png(figure: Any) -> bytes:
    file = io.BytesIO()
    figure.savefig(file, format="png", dpi=110)
    return file.getvalue()
