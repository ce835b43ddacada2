"""Closed loops on a GPU and on one core, errors of formulations."""

from __future__ import annotations

from docs.generate.figures.kinds import Cell, Figure, Number, Ratio

ROBOTS = {"four_bar": "four-bar", "cassie": "Cassie"}
MJX = tuple(f"MJX, {count} iterations" for count in (1, 4))


def _gpu() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    for robot in ROBOTS:
        file = f"loops-{robot}-nvidia-h200"

        def rate(what: str, file: str = file) -> Number:
            return Number(file, "M/s median", {"what": what})

        peer = Number(file, "M/s", {"what": MJX})
        for method in ("baumgarte", "projected"):
            name = f"loops.{robot}.{method}"
            out[name] = rate(method)
            out[f"{name}.over-mjx"] = Ratio(out[name], peer)
            out[f"{name}.left"] = Number(file, "rows left", {"what": method}, digits=2)
            out[f"{name}.gradient"] = Ratio(rate(f"gradient, {method}"), rate("gradient, open"), 2)
        out[f"loops.{robot}.mjx.left"] = Number(file, "rows left", {"what": MJX}, digits=2)
    return out


CORE = {"what": "loops", "batch": 4096}
FIGURES = _gpu() | {
    "loops.core": Number("cpu-loops-amd-epyc", "Pinocchio's time over ours", CORE, digits=2),
    "loops.core.difference": Number("cpu-loops-amd-epyc", "loops differ by", CORE, digits=1),
}


def _error(name: str, family: str, mechanism: str, digits: int = 2) -> Cell:
    return Cell("benchmarks/formulations.md", (name, family), mechanism, digits)


CRANK, PENDULUM = "spatial slider-crank", "Cartesian pendulum"
FIGURES |= {
    "formulations.drift": _error("multipliers", "redundant", CRANK),
    "formulations.drift.baumgarte": _error("baumgarte", "redundant", CRANK),
    "formulations.drift.projected": _error("projected", "redundant", CRANK),
    "formulations.pendulum": _error("multipliers", "redundant", PENDULUM, 1),
    "formulations.pendulum.index-2": _error("index 2", "redundant", PENDULUM, 1),
}
