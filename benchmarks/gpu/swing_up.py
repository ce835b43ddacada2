"""Swing-up of cart-pole and acrobot, 1,000 starts at once: `python -m benchmarks.gpu.swing_up`.

`[--tasks NAME ...] [--starts N] [--f32]`. What counts as solved, and the method:
`benchmarks.shared.swing_up`; in f32 the gap may be 1e-4. Writes results/gpu-swing-up-<device>.json,
with each start that failed.
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
    parser.add_argument("--f32", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", not given.f32)
    rows = []
    for name in given.tasks:
        rows.append(swing_up.run(swing_up.tasks()[name], given.starts, given.starts))
        print("failures:", rows[-1]["failures"], flush=True)
        save("gpu-swing-up", rows + others("gpu-swing-up", rows, ("task", "precision")))
    print(markdown_table(rows, swing_up.COLUMNS))


if __name__ == "__main__":
    main()
