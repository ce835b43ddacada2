"""Closed loops on a GPU and on one core."""

from __future__ import annotations

from docs.generate.figures.kinds import Figure, Number, Ratio

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
