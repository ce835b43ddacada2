"""Hybrid A* and A* beside grid_dijkstra, on a core: `python -m benchmarks.cpu.hybrid_a_star`.

`[--full]`: five maps, by default two, in results of their own. The maps and the car of
`benchmarks.cpu.grid_dijkstra`. Costs are in one unit. Those of hybrid A* lead exactly to the goal,
the others to a set around it. `smooth s` is the time of the smoother.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax

from benchmarks.shared.clutter import CAR, CONTROLS, HEADINGS, TOLERANCE, clutter, query
from benchmarks.shared.progress import add_full, progress, sized
from benchmarks.shared.timing import markdown_table, save
from rbjax.planning import Path, grid_a_star, grid_dijkstra, hybrid_a_star, smooth

RUNS, SPACING, STEPS = 5, 0.12, 192


def timed(f: Callable, *args: Any, **rest: Any) -> tuple[Any, float]:
    """The result, and the seconds of the best of some runs; the first compiles."""
    result, times = f(*args, **rest), []
    for _ in range(RUNS):
        start = time.perf_counter()
        jax.block_until_ready(f(*args, **rest))
        times.append(time.perf_counter() - start)
    return result, min(times)


def smoothed(path: Path, field: Any) -> dict[str, Any]:
    path = path.split(SPACING)
    rest = jax.numpy.zeros((STEPS - path.steps.shape[0], 3))
    path = Path(path.start, jax.numpy.concatenate([path.steps, rest]))
    better, seconds = timed(smooth, path, field, CAR, 1 / abs(CONTROLS.curvatures).max())
    return {"smooth s": seconds, "refinement": better.status, "smooth m": float(better.path.length)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_full(parser, "five maps", "two")
    full = parser.parse_args().full
    rows = []
    for seed in progress(range(5 if full else 2), lambda seed: f"map {seed}"):
        grid, places = clutter(seed)
        problem = grid, CAR, *query(places), CONTROLS
        for search, weight in (
            (grid_dijkstra, None), (grid_a_star, 1.0), (hybrid_a_star, 1.0), (hybrid_a_star, 1.2)
        ):  # fmt: skip
            near = () if search is hybrid_a_star else (TOLERANCE,)
            rest = {} if weight is None else {"weight": weight}
            plan, seconds = timed(search, *problem, *near, headings=HEADINGS, **rest)
            rows.append(
                {
                    "seed": seed, "search": search.__name__, "weight": weight,
                    "status": plan.status, "cost": plan.cost, "expanded": plan.expanded,
                    "s": seconds, "m": float(plan.path.length), "cusps": int(plan.path.cusps),
                }
            )  # fmt: skip
            if search is hybrid_a_star:
                rows[-1] |= smoothed(plan.path, grid.distance_field())
            print(markdown_table(rows[-1:], rows[-1]), flush=True)
    print(markdown_table(rows, rows[2]))
    print(save(sized("cpu-hybrid-a-star", full), rows))


if __name__ == "__main__":
    main()
