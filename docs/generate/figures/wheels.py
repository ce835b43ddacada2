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
        out[f"wheels.core.{short}"] = Number(core, "M steps/s", here)
    return out


def _softness(constant: float) -> Number:
    """Distance of a car from rolling by MuJoCo with this time constant of solref, mm."""
    where = {"robot": "car", "sweep": "stiffness", "time_constant": constant, "impratio": 100.0}
    return Number("wheel-contact-amd-epyc", "distance", where, min, 1e3, 2)


FIGURES = _rates() | {
    "wheels.contact.car.20": _softness(0.02),
    "wheels.contact.car.0.5": _softness(0.0005),
}
