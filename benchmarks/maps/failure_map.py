"""The failure map: every solver of the registry on scenes built to break it.

`python -m benchmarks.maps.failure_map [--jobs N] [--only rk4,bdf2]`, or `make failure-map`. Each
cell is the verdict of `rb.stability.attempt`: the largest error or the kind of failure. A solver's
scenes share its compiled programs, which take nearly all of the time. With several jobs each
process takes one solver at a time. With `--only` the rest of the map is that of the last run.
Results go to results/ and docs/benchmarks/figures/failure_map.png. Nothing is timed here; the whole
map took 20 minutes on a shared core.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
from pathlib import Path
from typing import Any

os.environ.setdefault("JAX_ENABLE_X64", "1")

import jax
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import Normalize
from matplotlib.patches import Patch, Rectangle
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.shared.charts import PAGE, save_chart, saved
from benchmarks.shared.timing import RESULTS, save
from rbjax import solvers
from rbjax.plotting import INK, STYLE
from rbjax.stability import Outcome, Truth, Verdict, attempt, scenes, truth

PICTURE = Path(__file__).parents[2] / "docs" / "benchmarks" / "figures" / "failure_map.png"
NAME = "failure-map"
MARGIN = 100  # an error below this many errors of the truth is shown as that
#: outcome -> letter, colour
SHOWN = {
    Outcome.BLOWS_UP: ("X", "#22303c"),
    Outcome.NO_ROOT: ("R", "#7a5ba8"),
    Outcome.OUT_OF_STEPS: ("S", "#8a5a3c"),
    Outcome.OFF_MANIFOLD: ("M", "#2a6fb0"),
    Outcome.DRIFTS: ("D", "#c8433f"),
    Outcome.LOST: ("L", "#e8832a"),
}
BEST, WORST = -12, -1  # log10 of the errors that the colours tell apart


def truths() -> dict[str, Truth]:
    """Scene -> the truth, computed once for scenes that differ only in the controller."""
    found: dict[Any, Truth] = {}
    out = {}
    for name, scene in scenes().items():
        if not scene.single:
            key = (scene.system, scene.start, scene.dt, scene.every)
            if key not in found:
                found[key] = truth(scene)
            out[name] = found[key]
    return out


def row(task: tuple[str, dict[str, Truth]]) -> dict[str, Any]:
    """All cells of a solver."""
    name, true = task
    entry = solvers.all()[name]
    cells = {}
    for title, scene in scenes().items():
        found = attempt(entry.make(), scene, true.get(title))
        cells[title] = None if found is None else cell(found)
    jax.clear_caches()
    return {"solver": name, "kind": entry.kind, "order": entry.order, "cells": cells}


def cell(found: Verdict) -> dict[str, Any]:
    numbers = [found.value] if found.error is None else [found.value, found.error]
    assert np.isfinite(numbers).all(), found
    return found._asdict() | {"outcome": found.outcome.value}


def last_rows() -> dict[str, dict[str, Any]]:
    """Solver -> its row in the existing results."""
    rows: dict[str, dict[str, Any]] = {}
    for path in sorted(RESULTS.glob(f"{NAME}-*.json")):
        rows |= {r["solver"]: r for r in json.loads(path.read_text())["rows"] if "solver" in r}
    return rows


def text(found: dict[str, Any] | None, floor: float) -> str:
    if found is None:
        return ""
    outcome = Outcome(found["outcome"])
    if outcome in SHOWN:
        return SHOWN[outcome][0]
    error = max(found["error"], floor)
    return f"{np.log10(error):.0f}" if error > 0 else "0"


def draw(rows: list[dict[str, Any]], floors: dict[str, float], path: Path) -> None:
    """Rows solvers, columns scenes."""
    columns = list(scenes().items())
    colours, scale = plt.get_cmap("YlGn_r"), Normalize(BEST, WORST + 3)
    with plt.rc_context(STYLE):
        figure, axis = plt.subplots(figsize=(PAGE, 14.5), layout="constrained")
        kind = None
        for y, one in enumerate(rows):
            if kind not in (None, one["kind"]):
                axis.axhline(y - 0.5, color=INK, lw=1.2, zorder=3)
            kind = one["kind"]
            for x, (name, _) in enumerate(columns):
                found, floor = one["cells"][name], floors.get(name, 0.0)
                word, fill, ink = text(found, floor), "#f3f4f5", INK
                if found is not None and Outcome(found["outcome"]) in SHOWN:
                    fill, ink = SHOWN[Outcome(found["outcome"])][1], "white"
                elif found is not None:
                    fill = colours(scale(np.log10(max(found["error"], floor, 1e-16))))
                    ink = "white" if np.mean(fill[:3]) < 0.45 else INK
                axis.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=fill,
                                         edgecolor="white", lw=0.8))  # fmt: skip
                axis.text(x, y, word, ha="center", va="center", fontsize=8, color=ink)
        axis.set(xlim=(-0.5, len(columns) - 0.5), ylim=(len(rows) - 0.5, -0.5))
        axis.xaxis.tick_top()
        axis.set_xticks(range(len(columns)), [s.title for _, s in columns], rotation=40, ha="left",
                        fontsize=8.5)  # fmt: skip
        axis.set_yticks(range(len(rows)), [one["solver"] for one in rows], fontsize=8.5)
        axis.tick_params(length=0)
        axis.grid(False)
        for side in axis.spines.values():
            side.set_visible(False)
        handles = [Patch(facecolor=colour, label=f"{letter}  {outcome.value}")
                   for outcome, (letter, colour) in SHOWN.items()]  # fmt: skip
        handles += [Patch(facecolor=colours(scale(p)), label=f"holds, error 1e{p}")
                    for p in (-12, -8, -4, -2)]  # fmt: skip
        handles.append(Patch(facecolor="#f3f4f5", label="does not apply"))
        figure.legend(handles=handles, loc="outside lower center", ncols=4, fontsize=8.5)
        figure.suptitle("Log10 of the largest error [rad], or how a solver fails",
                        x=0.01, ha="left", fontweight="bold")  # fmt: skip
        save_chart(figure, path)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--jobs", type=int, default=1, help="processes, each a solver at a time")
    parser.add_argument("--only", default="", help="names of solvers, by commas")
    parser.add_argument("--draw", action="store_true", help="only draw the saved results again")
    given = parser.parse_args()
    if given.draw:
        about, *rows = saved(f"{NAME}-*.json")
        floors = {name: MARGIN * error for name, error in about["errors_of_the_truth"].items()}
        draw(rows, floors, PICTURE)
        return
    names = [name for name in given.only.split(",") if name] or list(solvers.all())
    unknown = set(names) - solvers.all().keys()
    if unknown:
        parser.error(f"no such solver: {', '.join(sorted(unknown))}")
    print("the truth of each scene ...", flush=True)
    true = truths()
    rows = last_rows() if given.only else {}
    bar = (TextColumn("{task.description:24}"), BarColumn(), MofNCompleteColumn(),
           TimeElapsedColumn())  # fmt: skip
    with Progress(*bar) as progress:
        task = progress.add_task("solvers", total=len(names))
        tasks = [(name, true) for name in names]
        pool = multiprocessing.get_context("spawn").Pool(given.jobs) if given.jobs > 1 else None
        for found in pool.imap_unordered(row, tasks) if pool else map(row, tasks):
            rows[found["solver"]] = found
            progress.update(task, advance=1, description=found["solver"])
        if pool:
            pool.close()
            pool.join()
    ordered = [rows[name] for name in solvers.all() if name in rows]
    floors = {name: MARGIN * t.error for name, t in true.items()}
    about = {"scenes": {n: s.title for n, s in scenes().items()},
             "errors_of_the_truth": {n: t.error for n, t in true.items()}}  # fmt: skip
    print(save(NAME, [about, *ordered]))
    draw(ordered, floors, PICTURE)
    print(PICTURE)


if __name__ == "__main__":
    main()
