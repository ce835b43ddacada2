"""Slip of a robot on three omnidirectional wheels by floor, on headings that were not fitted.

`python -m benchmarks.cpu.slip_by_floor` writes results/cpu-slip_by_floor-<processor>.json. The
recordings lie beside the repository. An error is 1 - camera / wheels, of the distance between the
ends of a run, in %: `mean` over all headings that were not fitted, as encoders are judged; `each`,
the mean size of the error of one run; `rms`; `worst`. The first row of a floor is of encoders with
nominal geometry, the second with one radius, the third with the slip that the runs need.
`repeats` is the standard deviation between runs alike, which no model can explain.
"""

import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.cases.robotino import (  # noqa: E402
    ARM,
    DATA,
    FLOORS,
    fit,
    load,
    path_errors,
    repeatability,
    robotino,
)
from benchmarks.shared.timing import markdown_table, save  # noqa: E402
from rbjax import wheeled  # noqa: E402

COLUMNS = ("floor", "model", "unknowns", "runs", "mean", "each", "rms", "worst", "repeats", "fit_s")


def rows(floor: str) -> list[dict[str, Any]]:
    robot, runs = robotino(), load(floor)
    fitted = [run for run in runs if not run.held_out]
    unseen = [run for run in runs if run.held_out]
    start = time.perf_counter()
    found = fit(robot, fitted)
    seconds = time.perf_counter() - start
    scale = 1 - path_errors(robot, fitted, None).mean()
    none = wheeled.HeadingSlip.none(ARM)
    one = none.replace(coefficients=scale * none.coefficients)
    models = (
        ("encoders", None, 0, None),
        ("one radius", one, 1, None),
        (found.name, found.slip, found.slip.coefficients.size, seconds),
    )
    repeats = 100 * repeatability(runs)
    out = []
    for name, slip, unknowns, fit_s in models:
        e = 100 * path_errors(robot, unseen, slip)
        out.append({
            "floor": floor, "model": name, "unknowns": unknowns, "runs": len(unseen),
            "mean": e.mean(), "each": np.abs(e).mean(), "rms": np.sqrt((e**2).mean()),
            "worst": np.abs(e).max(), "repeats": repeats, "fit_s": fit_s,
        })  # fmt: skip
    out[-1]["comparisons"] = [c.summary() for c in found.comparisons]
    return out


if __name__ == "__main__":
    if DATA.exists():
        table = [row for floor in FLOORS for row in rows(floor)]
        print(markdown_table(table, COLUMNS))
        save("cpu-slip_by_floor", table)
    else:
        print(f"nothing measured: the recordings, {DATA.name}, do not lie beside the repository")
