"""The planner and the heap of Algorithm 10.2, on a core: `python -m benchmarks.cpu.grid_dijkstra`.

`[--full]`: three maps, by default one, in results of their own. A car among random boxes on a map
of 200 x 200 cells of 0.1 m, 72 headings, six controls. The oracle of the tests, plain NumPy and
heapq, takes minutes; both must find the same path.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import argparse
import time

from benchmarks.cases import algorithm_10_2
from benchmarks.shared.clutter import CAR, CONTROLS, HEADINGS, TOLERANCE, clutter, query
from benchmarks.shared.progress import add_full, progress, sized
from benchmarks.shared.timing import markdown_table, save
from rbjax.planning import grid_dijkstra


def timed(f, *args) -> tuple:
    start = time.perf_counter()
    return f(*args), time.perf_counter() - start


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    add_full(parser, "three maps", "one")
    full = parser.parse_args().full
    rows = []
    for seed in progress(range(3 if full else 1), lambda seed: f"map {seed}"):
        grid, places = clutter(seed)
        args = grid, CAR, *query(places), CONTROLS, TOLERANCE, HEADINGS, 10**9
        grid_dijkstra(*args)
        plan, seconds = min((timed(grid_dijkstra, *args) for _ in range(5)), key=lambda x: x[1])
        want, book = timed(algorithm_10_2.plan, grid, grid.distance_field(), *args[1:])
        assert (plan.status, plan.cost, plan.expanded) == (want.status, want.cost, want.expanded)
        assert plan.controls.tolist() == want.controls
        rows.append(
            {
                "seed": seed, "status": plan.status, "cost": plan.cost, "expanded": plan.expanded,
                "rbjax s": seconds, "heap s": book, "ratio": book / seconds,
            }
        )  # fmt: skip
        print(markdown_table(rows[-1:], rows[0]), flush=True)
    print(markdown_table(rows, rows[0]))
    print(save(sized("cpu-grid-dijkstra", full), rows))


if __name__ == "__main__":
    main()
