"""Robots on the floor: steps a second, agreement with MuJoCo C, errors of the laws."""

from __future__ import annotations

from docs.generate import measured
from docs.generate.figures.kinds import Figure, Number

H100 = "nvidia-h100-80gb-hbm3"
CORE = "cpu-contact-intel-r-xeon-r-processor"
MAP = "contact-map-amd-epyc"


def _gpu() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    for robot in ("humanoid", "humanoid_feet", "go1", "g1"):
        file = f"gpu-contact-{robot}-{H100}"
        for part in ("rollout", "free"):
            out[f"gpu.contact.{robot}.{part}"] = Number(
                file, "M/s median", {"what": part}, digits=2 if part == "rollout" else 3
            )
    for robot in ("humanoid", "g1"):
        where = {"engine": "MuJoCo Warp", "what": "contact", "robot": robot}
        out[f"gpu.contact.{robot}.warp"] = Number(measured.PUBLISHED, "M/s", where, digits=2)
    return out


def _core() -> dict[str, Figure]:
    return {
        f"cpu.contact.{robot}": Number(CORE, "over_mujoco", {"robot": robot}, digits=2)
        for robot in ("humanoid", "humanoid_feet", "go1")
    }


FIGURES = _gpu() | _core()
FIGURES["contact.sinks"] = Number(
    MAP, "error", {"scene": "mass_ratio", "law": "mujoco"}, min, digits=2
)
FIGURES["parity"] = Number("contact-parity-amd-epyc", "entry", digits=1)
