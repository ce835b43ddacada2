"""Identification on two cores: an arm with 55 unknowns, a quadruped in the air with 49.

`python -m benchmarks.cpu.identification` writes results/cpu-identification-<processor>.json. The
quadruped's files lie beside the repository; where they are not, it is left out. Seconds are those
of the whole call, with tracing and compiling. The error is that of the combinations that can be
found; sigmas is the largest error of a number that is found by itself, over its own sigma.
"""

import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.shared.timing import markdown_table, save  # noqa: E402
from rbjax.sysid import identify  # noqa: E402
from tests.sysid.problems import GO2, arm, quadruped  # noqa: E402

COLUMNS = ("problem", "unknowns", "found", "evaluations", "seconds", "error", "sigmas")


def row(name: str, make: Any) -> dict[str, Any]:
    setup, run, unknowns, truth, how = make()
    start = time.perf_counter()
    found = identify(setup, run, unknowns, **how)
    seconds = time.perf_counter() - start
    p = np.array([*found.values.values()])
    off = np.abs(found.found.combine(p) - found.found.combine(truth))
    sigma = found.estimates.sigma
    noisy = max(map(np.max, found.rms.values())) > 1e-9
    sigmas = float(np.abs((p - truth) / sigma)[np.isfinite(sigma)].max()) if noisy else None
    return {
        "problem": name, "unknowns": len(truth), "found": found.found.rank,
        "evaluations": found.evaluations, "seconds": seconds, "error": float(off.max()),
        "sigmas": sigmas, "ok": found.ok,
    }  # fmt: skip


if __name__ == "__main__":
    rows = [row("arm", arm)]
    if GO2.exists():
        rows.append(row("quadruped", quadruped))
    print(markdown_table(rows, COLUMNS))
    save("cpu-identification", rows)
