"""Whether the first call of `identify`, with its defaults, tells the truth: an arm of two links
with dry friction, recorded in MuJoCo C (`benchmarks/shared/dry_arm.py`), 20 draws.

`python -m benchmarks.cpu.identify_arm_truth [--draws N]` writes
results/cpu-identify-arm-truth-<processor>.json. inside: of the 8 numbers, how many lie in their
95 % intervals (asked: 93 to 97 % of all); r2: the share of variance explained; good: the verdict,
which must not be given below 0.99; held out: the same of another recording. The model is in
float32, JAX's default. The first draw compiles; others reuse its programs.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np

from benchmarks.shared.dry_arm import TRUTH, UNKNOWNS, guess, recorded
from benchmarks.shared.progress import progress
from benchmarks.shared.timing import markdown_table, save
from rbjax.sysid import identify

COLUMNS = (
    "draw", "seconds", "evaluations", "inside", "worst", "r2", "good", "held out", "tries", "steps",
)  # fmt: skip


def row(seed: int) -> dict[str, Any]:
    model, run = guess(seed), recorded(seed)
    begin = time.perf_counter()
    found = identify(model, run, UNKNOWNS)
    seconds = time.perf_counter() - begin
    spans = [found.estimates.interval(name) for name in found.values]
    inside = [x.low <= y <= x.high for x, y in zip(spans, TRUTH, strict=True)]
    off = [(x.value - y) / x.sigma for x, y in zip(spans, TRUTH, strict=True)]
    unseen = found.validate([recorded(seed, held_out=True)])
    return {
        "draw": seed, "seconds": seconds, "evaluations": found.evaluations,
        "inside": int(sum(inside)), "worst": float(np.abs(off).max()),
        "r2": found.verdict.r_squared["q"], "good": found.verdict.success,
        "held out": unseen.success,
        "tries": sum("starts were tried" in n or "start was tried" in n for n in found.notes),
        "steps": found.grid.period / found.grid.substeps, "verdict": found.verdict.summary(),
        "notes": list(found.notes), "sigmas": off,
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--draws", type=int, default=20)
    draws = parser.parse_args().draws
    found = []
    for seed in progress(range(draws), lambda seed: f"draw {seed}"):
        found.append(row(seed))
        print({k: found[-1][k] for k in COLUMNS}, flush=True)
    print(markdown_table(found, COLUMNS))
    share = sum(r["inside"] for r in found) / (len(TRUTH) * len(found))
    wrong = sum(r["good"] and r["r2"] < 0.99 for r in found)
    print(f"{100 * share:.1f} % inside; {wrong} fits with R2 below 0.99 called good")
    save("cpu-identify-arm-truth", found)
