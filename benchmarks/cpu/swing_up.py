"""Swing-up of cart-pole and acrobot from 1,000 starts: `python -m benchmarks.cpu.swing_up`.

`[--tasks NAME ...] [--starts N]`. What counts as solved, and the method:
`benchmarks.shared.swing_up`. Writes results/cpu-swing-up-<processor>.json, with each failure.
"""

from __future__ import annotations

import argparse

import jax

from benchmarks.shared import swing_up
from benchmarks.shared.timing import markdown_table, others, save


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tasks", nargs="*", default=["cart_pole", "acrobot"])
    parser.add_argument("--starts", type=int, default=1000)
    parser.add_argument("--chunk", type=int, default=100)
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    rows = []
    for name in given.tasks:
        rows.append(swing_up.run(swing_up.tasks()[name], given.starts, given.chunk))
        print("failures:", rows[-1]["failures"], flush=True)
        save("cpu-swing-up", rows + others("cpu-swing-up", rows, ("task",)))
    print(markdown_table(rows, swing_up.COLUMNS))


if __name__ == "__main__":
    main()
