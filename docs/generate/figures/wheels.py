"""Wheeled robots: rollouts, and wheels on contacts compared with rolling ones."""

from __future__ import annotations

from docs.generate.figures.kinds import Figure, Number

ROBOTS = {"drive": "differential drive", "omni": "omni-3", "car": "car",
          "omni-slip": "omni-3 with slip", "car-tyres": "car on tyres"}  # fmt: skip
KNOWN = {"method": "semi_implicit_euler", "robot_is": "known"}


def _rates() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    for short, robot in ROBOTS.items():
        here = KNOWN | {"what": robot}
        gpu, core = "gpu-wheeled-nvidia-h200", "cpu-wheeled-amd-epyc"
        out[f"wheels.gpu.{short}"] = Number(gpu, "M/s", here)
        out[f"wheels.gpu.{short}.limit"] = Number(gpu, "of limit", here, scale=100)
        out[f"wheels.core.{short}"] = Number(core, "M steps/s", here)
        out[f"wheels.core.{short}.limit"] = Number(core, "of limit", here, digits=2)
    return out


FIGURES = _rates()
