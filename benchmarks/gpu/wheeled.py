"""Rollouts of wheeled robots on a GPU, one robot a thread, f32, and the device's limit.

`python -m benchmarks.gpu.wheeled [SCENE ...]`. The limit is one operation an instruction
(`rb.compiler.explain`) on all lanes at the largest clock: `of limit` is the share of it.
"""

from __future__ import annotations

import argparse

from benchmarks.shared.gpu_timing import timed
from benchmarks.shared.timing import markdown_table, others, save
from benchmarks.shared.wheeled_rollouts import SCENES, STEPS, cases
from rbjax.compiler.cuda import driver
from rbjax.compiler.jax.launch import capability

BATCHES = (65_536, 1_048_576)
COLUMNS = ("what", "method", "robot is", "batch", "operations", "compile_s", "M/s", "of limit")


def rows(scene: str, batch: int) -> list[dict]:
    out = []
    for case in cases(scene, batch):
        row = case.row | {"operations": case.operations}
        row = timed(row, case.run, *case.args, work=batch * STEPS)
        if "M/s" in row:
            peak = driver.limits(capability()).instructions
            row["of limit"] = row["M/s"] * 1e6 * case.operations / peak
        out.append(row)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", nargs="*", default=list(SCENES))
    chosen = parser.parse_args().scenes
    found = [row for scene in chosen for batch in BATCHES for row in rows(scene, batch)]
    save("gpu-wheeled", found + others("gpu-wheeled", found, COLUMNS[:4]))
    print(markdown_table(found, COLUMNS))


if __name__ == "__main__":
    main()
