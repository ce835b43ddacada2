"""Robots on the floor: steps a second, agreement with MuJoCo C, errors of the laws."""

from __future__ import annotations

from docs.generate.figures.kinds import Figure, Number, Ratio

GPU = "nvidia-h200"
CORE = "cpu-contact-amd-epyc"
MAP = "contact-map-amd-epyc"


def _seconds(row: dict) -> float:
    return row["lower_s"] + row["compile_s"]


def _gpu() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    for robot in ("humanoid", "humanoid_feet", "go1", "g1"):
        for part in ("rollout", "free", "mjx"):
            file = f"gpu-contact-{robot}-{GPU}"
            where = {"what": "mjx, 4 Newton steps" if part == "mjx" else part}
            digits = 3 if part == "free" else 2
            out[f"gpu.contact.{robot}.{part}"] = Number(file, "M/s median", where, digits=digits)
        columns = "gradient, rollout", "rollout", "gradient, free"
        gradient, bound, free = (Number(file, "M/s median", {"what": what}) for what in columns)
        out[f"gpu.contact.{robot}.gradient"] = Ratio(gradient, free, digits=2)
        out[f"gpu.contact.{robot}.gradient.bound"] = Ratio(bound, free, digits=2)
        for part in ("rollout", "gradient, rollout"):
            name = "gradient.compile" if part.startswith("gradient") else "compile"
            out[f"gpu.contact.{robot}.{name}"] = Number(file, _seconds, {"what": part}, digits=2)
    for robot in ("humanoid", "humanoid_feet", "go1"):
        file, where = f"gpu-warp-contact-{robot}-{GPU}", {"what": "converged", "batch": 65536}
        out[f"gpu.contact.{robot}.warp"] = Number(file, "M/s median", where, digits=2)
    return out


def _core() -> dict[str, Figure]:
    return {
        f"cpu.contact.{robot}": Number(CORE, "over_mujoco", {"robot": robot}, digits=2)
        for robot in ("humanoid", "humanoid_feet", "go1", "g1")
    }


FIGURES = _gpu() | _core()
FIGURES["contact.sinks"] = Number(
    MAP, "error", {"scene": "mass_ratio", "law": "mujoco"}, min, digits=2
)
FIGURES["parity"] = Number("contact-parity-amd-epyc", "entry", digits=1)
