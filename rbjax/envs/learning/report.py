"""Progress of a training: a line with the time left, a table (CSV), a chart (PNG)."""

from __future__ import annotations

import csv
import math
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from rbjax.display import displayed
from rbjax.envs.task_table import monitor_display
from rbjax.errors import InputError
from rbjax.optional import require
from rbjax.progress import has_live_lines, progress_line
from rbjax.style import STYLE


@displayed
class Monitor:
    """Record the progress of a training. An instance is the `report` of a learner.

    Args:
        label: name of the training.
        steps: number of steps of the environment in the whole training.
        folder: folder of "table.csv" and "chart.png"; None for none.
        show: whether the progress is printed: a line on a terminal, else a line for each report.

    Attributes:
        rows: the reports, each a dict with "seconds" since the beginning, "steps",
            "steps_per_second" since the last report, "reward" and further figures.

    Example:
        >>> from rbjax.envs.learning import Monitor
        >>> with Monitor("balance", 200, show=False) as monitor:
        ...     monitor(100, {"reward": 1.0}, None)
        >>> monitor.rows[0]["steps"]
        100
    """

    _display_ = monitor_display

    def __init__(
        self, label: str, steps: int, folder: str | Path | None = None, show: bool = True
    ) -> None:
        self.label, self.steps, self.show = label, steps, show
        self.folder: Path | None = None
        self.rows: list[dict[str, float]] = []
        self._began, self._live = time.perf_counter(), has_live_lines()
        self._say: Callable[[str], None] = lambda text: None
        if folder is not None:
            require("Monitor", "matplotlib", "folder=None, which draws no chart")
            self.folder = Path(folder)
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"Monitor: the folder {folder} cannot be made: {error}") from error

    def __enter__(self) -> Monitor:
        self._began = time.perf_counter()
        self._line = progress_line(self.label, self.show)
        self._say = self._line.__enter__()
        self._say("compiling")
        return self

    def __exit__(self, *error: Any) -> None:
        self._line.__exit__(*error)
        if self.folder is not None and self.rows:
            learning_curve(self.rows, self.folder / "chart.png", self.label)

    def __call__(self, steps: int, figures: Mapping[str, float], policy: Any = None) -> None:
        """Add a report. steps: of the environment so far. figures: name -> number."""
        seconds = time.perf_counter() - self._began
        last = self.rows[-1] if self.rows else {"seconds": 0.0, "steps": 0}
        spent = max(seconds - last["seconds"], 1e-9)
        speed = (steps - last["steps"]) / spent
        row = {"seconds": seconds, "steps": steps, "steps_per_second": speed}
        self.rows.append(row | {name: float(x) for name, x in figures.items()})
        text = _sentence(self.rows[-1], self.steps)
        self._say(text)
        if self.show and not self._live:
            print(f"{seconds:6.1f} s  {self.label}: {text}", file=sys.stderr, flush=True)
        if self.folder is not None:
            write_table(self.rows, self.folder / "table.csv")


def _sentence(row: Mapping[str, float], total: int) -> str:
    steps, speed = row["steps"], row["steps_per_second"]
    left = (total - steps) / speed if speed > 0 else math.nan
    parts = [f"{steps:,} of {total:,} steps", f"{speed:,.0f} a second"]
    if math.isfinite(row.get("reward", math.nan)):
        parts.insert(1, f"reward {row['reward']:.4g}")
    if math.isfinite(left):
        parts.append(f"{max(left, 0.0):.0f} s left")
    return ", ".join(parts)


def write_table(rows: Sequence[Mapping[str, float]], path: Path) -> None:
    """Write rows of figures as CSV. A figure that a row lacks is empty."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, names)
        table.writeheader()
        table.writerows(rows)


def learning_curve(rows: Sequence[Mapping[str, float]], path: Path, title: str = "") -> None:
    """Draw the reward of an episode over the steps and over the time.

    Args:
        rows: reports of a `Monitor`; those without a finite "reward" are left out.
        path: file of the picture.
        title: title of the chart.

    Example:
        >>> import pathlib, tempfile
        >>> from rbjax.envs.learning.report import learning_curve
        >>> path = pathlib.Path(tempfile.mkdtemp()) / "chart.png"
        >>> rows = [{"seconds": t, "steps": 1000 * t, "reward": t * t} for t in range(5)]
        >>> learning_curve(rows, path)
        >>> path.exists()
        True
    """
    matplotlib = require("learning_curve", "matplotlib")
    Figure = require("learning_curve", "matplotlib.figure").Figure
    known = [row for row in rows if math.isfinite(row.get("reward", math.nan))]
    rewards = [row["reward"] for row in known]
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=(9, 3.4), layout="constrained")
        axes = figure.subplots(1, 2, sharey=True)
        for ax, name, unit, label in (
            (axes[0], "steps", 1e6, "million steps of the robot"),
            (axes[1], "seconds", 1.0, "seconds, with compiling"),
        ):
            x = [row[name] / unit for row in known]
            ax.plot(x, rewards, marker="o", ms=3)
            ax.set(xlabel=label)
            if known and "reward_std" in known[0]:
                spread = [row["reward_std"] for row in known]
                low = [r - s for r, s in zip(rewards, spread, strict=True)]
                high = [r + s for r, s in zip(rewards, spread, strict=True)]
                ax.fill_between(x, low, high, alpha=0.2, lw=0)
        axes[0].set(ylabel="reward of an episode", title=title)
        figure.savefig(path)
