"""Solvers and formulations: errors, steps, failures."""

from typing import Any

from docs.generate.subjects.tables import Column as C
from docs.generate.subjects.tables import Pivot, Table

PRECISION = "make bench-work-precision"


def scene(name: str) -> C:
    """What a solver did in a scene of the failure map: its error, or how it failed."""

    def of(row: dict[str, Any]) -> Any:
        cell = row["cells"].get(name) or {}
        outcome, value = cell.get("outcome"), cell.get("value")
        return (
            outcome
            if value is None
            else f"{value:.0e}"
            if outcome == "holds"
            else f"{outcome} {value:.0e}"
        )

    return C(of, name)


SCENES = ("spring_1e2", "spring_1e4", "spring_1e6", "spring_1e9")

TABLES = {
    "failure map": Table(
        ("failure-map-*",),
        (C("solver"), C("kind"), C("order"), *(scene(name) for name in SCENES)),
        "make failure-map",
        lambda row: "cells" in row,
    ),
    "integrators of other engines": Table(
        ("work-peer-integrators-*",),
        (C("engine"), C("integrator"), C("error", "difference to MuJoCo C", 1), C("note")),
        "python -m benchmarks.work.peer_integrators",
    ),
    "stiffness": Table(
        ("work-stiffness-*",),
        (
            C("stiffness", "stiffness, N m/rad"),
            C("method"),
            C("implicit"),
            C("steps"),
            C("us", "us"),
            C("error", digits=2),
        ),
        PRECISION,
        lambda row: row["what"] == "stiff",
    ),
    "formulations": Pivot(
        ("work-formulations-*",),
        (C("formulation"), C("family")),
        "title",
        C("error", "the error of q and v at the end", 2),
        PRECISION,
        lambda row: row["what"] == "run" and row["rung"] == 3,
        min,
    ),
    "formulation costs": Pivot(
        ("work-formulations-*",),
        (C("formulation"), C("family")),
        "title",
        C("step_us", "microseconds a step"),
        PRECISION,
        lambda row: row["what"] == "run",
        min,
    ),
    "references": Table(
        ("work-precision-*",),
        (
            C("scene"),
            C("on"),
            C("seconds", "simulated, s"),
            C("bound", "bound of the reference's error", 2),
        ),
        PRECISION,
        {"what": "reference"},
    ),
    "steps": Pivot(
        ("work-precision-*",),
        (C("scene"), C("on"), C("engine"), C("precision")),
        "method",
        C("us_per_step", "microseconds a robot and step", 2),
        PRECISION,
        {"what": "step"},
        min,
    ),
    "solver references": Table(
        ("work-solvers-*",),
        (
            C("scene"),
            C("on"),
            C("seconds", "simulated, s"),
            C("bound", "bound of the reference's error", 2),
        ),
        PRECISION,
        {"what": "reference"},
    ),
}
