"""The measured trainings of a task: a table, and curves."""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any

import numpy as np

from docs.generate import measured

ALGORITHMS = {"ppo": "PPO (Brax)", "shac": "SHAC"}


def trainings(name: str) -> dict[str, Any]:
    """The measured trainings of a task: (algorithm, device) -> row."""
    out = {}
    for file in measured.names():
        for algorithm in ALGORITHMS:
            if file.startswith(f"training-{name.replace('_', '-')}-{algorithm}-"):
                out[algorithm, measured.subject(file)[1]] = measured.read(file)["rows"][0]
    return out


def results(curves: dict[str, Any]) -> Iterable[tuple[str, ...]]:
    """The last report of each training, and the evaluation after it, if it is in the same task."""
    for (algorithm, device), row in curves.items():
        last = row["curve"][-1]
        same = row.get("judge", row["task"]) == row["task"]
        reward = measured.evaluation(row)["return"] if same else last["reward"]
        figures = f"{last['steps'] / 1e6:.3g} M", f"{last['seconds']:.0f}", f"{reward:.4g}"
        yield ALGORITHMS[algorithm], device, *figures


def chart(curves: dict[str, Any]) -> bytes:
    """The reward of an episode over the steps of each training."""
    import matplotlib
    from matplotlib.figure import Figure

    from rbjax.style import STYLE

    with matplotlib.rc_context({**STYLE, "svg.hashsalt": "tasks"}):
        figure = Figure(figsize=(7, 2.8), layout="constrained")
        ax = figure.subplots()
        for (algorithm, device), row in curves.items():
            points = [(p["steps"] / 1e6, p["reward"]) for p in row["curve"] if p["reward"]]
            x, y = np.array([p for p in points if np.isfinite(p[1])]).T
            ax.plot(x, y, marker="o", ms=3, label=f"{ALGORITHMS[algorithm]}, {device}")
        ax.set(xlabel="million steps of the robot", ylabel="reward of an episode")
        ax.set_xlim(left=0)
        ax.legend(loc="lower right")
        file = io.BytesIO()
        figure.savefig(file, format="svg", metadata={"Date": None}, facecolor="white")
    return file.getvalue()
