"""Error of beam formulations against coordinates and against time.

`python -m benchmarks.flexible.reference_accuracy [--scenes elastica bend flying spin_up]
[--formulations "strain coordinates" ...] [--small]` writes
results/flexible-reference-accuracy-<device>.json. An error is the largest deviation of the scene's
answer, in m, from closed forms or converged digits; `benchmarks.flexible.beam_scenes` has
the scenes and says how to add a formulation, and `benchmarks.flexible.own_beams` the beams that are
models. Compilation is not counted. In a motion the step falls with the segments.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # isort: skip  # noqa: F401

import argparse

import jax
from rich.console import Console
from rich.table import Table

from benchmarks.flexible.beam_scenes import ANSWERS, Entry, measure, references
from benchmarks.flexible.own_beams import own_beams
from benchmarks.shared.timing import others, save

NAME = "flexible-reference-accuracy"
SEGMENTS = {"elastica": (4, 8, 16, 32), "bend": (4, 8, 16, 32), "flying": (8, 16, 32),
            "spin_up": (4, 8, 16)}  # fmt: skip


def compare(entries: list[Entry], scenes: list[str], small: bool = False) -> list[dict]:
    """Rows of all entries on all scenes, at every resolution."""
    found = []
    for scene in scenes:
        for entry in entries:
            for segments in SEGMENTS[scene][: 2 if small else None]:
                row = measure(entry, scene, segments, 1 if small else 3)
                if row is None:
                    break
                found.append(row)
                print(row, flush=True)
    return found


def show(rows: list[dict]) -> None:
    """Print the rows as a table."""
    table = Table("scene", "formulation", "coordinates", "error", "ms")
    for row in rows:
        error, run_s = row["error"], row["run_s"]
        cells = ("-", "-") if error is None else (f"{error:.2e}", f"{1e3 * run_s:.1f}")
        table.add_row(row["scene"], row["formulation"], str(row["coordinates"]), *cells)
    Console().print(table)


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    parser = argparse.ArgumentParser()
    parser.add_argument(
        "--scenes", nargs="+", choices=ANSWERS, default=["elastica", "bend", "flying"]
    )
    parser.add_argument("--small", action="store_true", help="two resolutions, one run")
    entries = references() + own_beams()
    names = [entry.name for entry in entries]
    parser.add_argument("--formulations", nargs="+", choices=names, default=names)
    given = parser.parse_args()
    chosen = [entry for entry in entries if entry.name in given.formulations]
    rows = compare(chosen, given.scenes, given.small)
    show(rows)
    if not given.small:
        save(NAME, rows + others(NAME, rows, ["scene", "formulation", "segments"]))
