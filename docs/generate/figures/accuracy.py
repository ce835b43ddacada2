"""Errors against MuJoCo C over the list of models, and of MJX beside them."""

from __future__ import annotations

from docs.generate.figures.kinds import Count, Figure, Number, Rows

GPU, CPU = "gpu-accuracy-nvidia-h200", "accuracy-amd-epyc"
WARP = "accuracy-warp-amd-epyc"


def _both(row: dict) -> bool:
    return None not in (row.get("rbjax median"), row.get("MJX median"))


FIGURES: dict[str, Figure] = {
    "accuracy.f32": Number(GPU, "rbjax median", digits=2),
    "accuracy.f32.max": Number(GPU, "rbjax max", digits=2),
    "accuracy.f32.mjx": Number(GPU, "MJX median", digits=2),
    "accuracy.f32.warp": Number(WARP, "median", digits=2),
    "accuracy.f32.warp.models": Rows(WARP, lambda row: "median" in row),
    "accuracy.f32.models": Rows(GPU, _both),
    "accuracy.f32.lower": Rows(
        GPU, lambda row: _both(row) and row["rbjax median"] < row["MJX median"]
    ),
    "accuracy.f64": Number(CPU, "f64 max", digits=1),
    "accuracy.core.f32": Number(CPU, "f32 median", digits=2),
    "accuracy.core.f32.max": Number(CPU, "f32 max", digits=2),
    "accuracy.core.f32.mjx": Number(CPU, "MJX f32 FD median", digits=2),
    "accuracy.models": Count(CPU, "model"),
}
