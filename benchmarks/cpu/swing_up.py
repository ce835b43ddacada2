"""Swing-up of cart-pole and acrobot: `python -m benchmarks.cpu.swing_up [--full]`.

`[--tasks NAME ...] [--starts N]`: --full has 1,000 starts, the default 100, in results of their
own. What counts as solved, and the method: `benchmarks.shared.swing_up`. Writes
results/cpu-swing-up-<processor>.json, with each failure.
"""

from __future__ import annotations

import argparse

import jax

from benchmarks.shared import swing_up
from benchmarks.shared.progress import add_full, progress, sized
from benchmarks.shared.timing import markdown_table, others, save


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="*", default=["cart_pole", "acrobot"])
    parser.add_argument("--starts", type=int, help="another number of them")
    parser.add_argument("--chunk", type=int, default=100)
    add_full(parser, "1,000 starts", "100")
    given = parser.parse_args()
    starts = given.starts or (1000 if given.full else 100)
    results = sized("cpu-swing-up", starts >= 1000)
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name in progress(given.tasks):
        rows.append(swing_up.run(swing_up.tasks()[name], starts, given.chunk))
        print("failures:", rows[-1]["failures"], flush=True)
        save(results, rows + others(results, rows, ("task",)))
    print(markdown_table(rows, swing_up.COLUMNS))


if __name__ == "__main__":
    main()
