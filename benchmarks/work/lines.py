"""Rows of the speed-accuracy benchmarks as lines: error against time or evaluations."""

from __future__ import annotations

import json
from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.shared.timing import RESULTS
from benchmarks.work.scenes import SCENES

DOCS = RESULTS.parents[1] / "docs" / "benchmarks"
FIGURES = DOCS / "figures"
WANTED = 1e-6
FARTHEST = 300  # times the wanted error, up to which a line is extrapolated to it
CPU, GPU = "CPU, one core", "H200"
Rows = list[dict[str, Any]]


def read(folders: list[Path]) -> tuple[Rows, Rows]:
    """Rows of the scenes, each with its platform, those of `simulate` from work-solvers-*.json;
    rows of the stiffness sweep."""
    scenes, stiff = [], []
    kinds = ("work-precision-*.json", "work-solvers-*.json", "work-stiffness-*.json")
    for path in sorted(p for folder in folders for kind in kinds for p in folder.glob(kind)):
        data = json.loads(path.read_text())
        platform = CPU if data["provenance"]["platform"] == "cpu" else GPU
        rows = [row | {"platform": platform} for row in data["rows"]]
        if not path.name.startswith("work-solvers"):
            rows = [row for row in rows if row.get("engine") != "simulate"]
        (stiff if path.name.startswith("work-stiffness") else scenes).extend(rows)
    return scenes, stiff


def lines(rows: Rows, scene: str, platform: str) -> dict[tuple[str, str, str], Any]:
    """(engine, method, precision) -> steps, errors, microseconds, evaluations; the times of MJX are
    its steps times its fastest step."""
    found: dict[tuple, list] = defaultdict(list)
    step: dict[tuple, float] = {}
    for row in rows:
        if row["scene"] != scene:
            continue
        key = tuple(row.get(k) for k in ("engine", "method", "precision"))
        if row["what"] == "step" and row["platform"] == platform:
            step[key] = min(step.get(key, np.inf), row["us_per_step"])
        mine = row["what"] == "point" and row["platform"] == platform
        if mine or row["what"] == "error":
            found[key].append([row["steps"], row["error"], row.get("us"), row.get("evaluations")])
    if scene == "chain":  # only hinges: MJX's RK4 equals MuJoCo's, whose errors were affordable
        found["mjx", "RK4", "f64"] = [
            [row["steps"], row["error"], None, row["evaluations"]]
            for row in rows
            if row["scene"] == scene and (row.get("engine"), row.get("method")) == ("mujoco", "RK4")
        ]
    out = {}
    for key, points in found.items():
        steps, error, us, evaluations = np.array(sorted(points, key=lambda p: p[0]), float).T
        if key[0] == "mjx":
            if key not in step:
                continue
            us = steps * step[key] / SCENES[scene].seconds
        out[key] = steps, error, us, evaluations
    return out


def at(error: np.ndarray, cost: np.ndarray, wanted: float = WANTED) -> tuple[float, bool]:
    """The cost of an error, by interpolation, and whether the line was extrapolated with the slope
    of its last two points. Infinite if the line ends in a floor above the error, or far away."""
    good = np.flatnonzero(error <= wanted)
    if len(good) and good[0]:
        i = good[0]
        if not np.isfinite(error[i - 1]):
            return float(cost[i]), False
        x, y = np.log(error[i - 1 : i + 1]), np.log(cost[i - 1 : i + 1])
        return float(np.exp(np.interp(-np.log(wanted), -x, y))), False
    if len(good):
        return float(cost[0]), False
    falling = np.flatnonzero(np.isfinite(error))[-2:]
    x, y = np.log(error[falling]), np.log(cost[falling])
    if len(x) < 2 or x[1] > x[0] - 0.1 or x[1] > np.log(FARTHEST * wanted):
        return np.inf, False
    slope = (y[1] - y[0]) / (x[1] - x[0])
    return float(np.exp(y[1] + slope * (np.log(wanted) - x[1]))), True


def visible(error: np.ndarray) -> np.ndarray:
    """Errors without meaningless ones: MuJoCo restarts where a motion blows up."""
    return np.where((error < 0.9) & (error > 0), error, np.nan)
