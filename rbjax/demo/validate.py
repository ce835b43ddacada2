"""Comparison of bundled scenes with MuJoCo C, in one table."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax

from rbjax.demo.report import ReportSection
from rbjax.validation import Report, compare

#: scene -> whether to compare the gradient of its trajectory too
SCENES = {
    "pendulum": True,
    "double_pendulum": True,
    "cart_pole": True,
    "spinning_top": True,
    "quadrotor": False,
    "arm7": False,
    "humanoid": False,
}


def validate(
    folder: Path, say: Callable[[str], None], *, scenes: dict[str, bool] | None = None
) -> ReportSection:
    """Compare the scenes with MuJoCo C, and make a table. Return the section of the report."""
    chosen = SCENES if scenes is None else scenes

    def compared(scene: str) -> Report:
        with jax.enable_x64(True):  # this setting is per thread
            return compare(
                scene,
                states=20,
                mjx=False,
                gradient=chosen[scene],
                driver="auto" if chosen[scene] else "rolled",  # compiles faster
                progress=lambda stage: say(f"validation: {scene}, {stage}"),
            )

    with ThreadPoolExecutor(2) as pool:  # XLA compiles one while Python traces another
        reports = list(pool.map(compared, reversed(chosen)))[::-1]  # the largest first
    names = max((tuple(row.quantity for row in report.rows) for report in reports), key=len)
    columns = [(n, "rbjax f64") for n in names]
    columns += [("forward dynamics", "rbjax f32"), ("trajectory", "rbjax f32")]
    rows = []
    for report in reports:
        cells = []
        for quantity, column in columns:
            row = next((r for r in report.rows if r.quantity == quantity), None)
            error = None if row is None else row.errors.get(column)
            cells.append("-" if error is None else f"{error.worst:.0e}")
        rows.append((report.model, *cells, "yes" if report.success else "NO"))
    passed = sum(report.success for report in reports)
    text = (
        "Two engines get the same file and the same states. The table has the worst relative error "
        "over 20 random states of poses, velocities, mass matrix, bias forces, forward dynamics, "
        "one step, the final state of a one-second trajectory, and the gradient of this state. "
        f"{passed} of {len(reports)} scenes are within tolerance (1e-10 in f64 and 1e-4 in f32 for "
        "functions of one state; trajectories may amplify rounding as those of MuJoCo do).",
    )
    return ReportSection(
        "Validate: against MuJoCo C",
        text,
        columns=("scene", *(f"{n} ({c[6:]})" for n, c in columns), "passed"),
        rows=tuple(rows),
        note="Worst relative error against MuJoCo C in f64. Contacts, limits, friction loss and "
        "implicit damping are off on both sides. `rbjax validate FILE` adds MJX in f32 and f64.",
        code="report = rb.validation.compare('arm7')\n"
        "report.success, report.table(), report.to_dict()",
    )
