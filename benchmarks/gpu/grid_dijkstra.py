"""Many searches of the planner at once: `python -m benchmarks.gpu.grid_dijkstra [n] [--f64]`.

Random starts and goals among random boxes, 200 x 200 cells and 72 headings. A few of the searches
are repeated one after the other by `grid_dijkstra` on the host: in f64 costs are the same, in f32
nodes on the edge of a cell may fall on the other side.
"""

from __future__ import annotations

import sys
import time

import jax
import numpy as np

from benchmarks.shared.clutter import CAR, CONTROLS, HEADINGS, TOLERANCE, clutter
from benchmarks.shared.timing import markdown_table, save
from rbjax.planning import grid_dijkstra, grid_dijkstra_many

CHECKED = 8


def main(searches: int, double: bool) -> None:
    jax.config.update("jax_enable_x64", double)
    grid, places = clutter(0)
    rng = np.random.default_rng(1)
    xy = places[rng.integers(0, len(places), (2, searches))]
    starts, goals = np.concatenate([xy, rng.uniform(-3, 3, (2, searches, 1))], -1)
    rest = CONTROLS, TOLERANCE, HEADINGS
    times = []
    for _ in range(3):  # the first compiles
        begin = time.perf_counter()
        plans = grid_dijkstra_many(grid, CAR, starts, goals, *rest)
        times.append(time.perf_counter() - begin)
    begin = time.perf_counter()
    ones = [grid_dijkstra(grid, CAR, *x, *rest) for x in zip(starts[:CHECKED], goals, strict=False)]
    host = (time.perf_counter() - begin) / CHECKED
    same = sum((a.status, a.cost) == (b.status, b.cost) for a, b in zip(plans, ones, strict=False))
    row = {
        "searches": searches, "precision": "f64" if double else "f32", "all s": min(times),
        "compiling s": times[0] - min(times), "found": sum(plan.found for plan in plans),
        "cells": sum(plan.expanded for plan in plans), "host s each": host,
        "same cost": f"{same} of {CHECKED}",
    }  # fmt: skip
    print(markdown_table([row], row))
    print(save("gpu-grid-dijkstra", [row]))


if __name__ == "__main__":
    numbers = [int(x) for x in sys.argv[1:] if x.isdigit()]
    main(*(numbers or [1024]), double="--f64" in sys.argv)
