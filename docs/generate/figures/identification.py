"""Identification: simulated recordings, intervals, and the real data sets."""

from __future__ import annotations

from docs.generate import measured
from docs.generate.figures.kinds import Figure, Number, Ratio, Rows

CORE, XEON, H100 = "amd-epyc", "intel-r-xeon-r-processor", "nvidia-h100-80gb-hbm3"


def _piece(row: measured.Row) -> bool:
    """Whether the row is of one recording, not the median or the largest of all."""
    return str(row.get("piece")).startswith(("id", "vad"))


def _simulated() -> dict[str, Figure]:
    file = f"cpu-identification-{CORE}"
    arm = {"problem": "arm, 55 numbers", "engine": "rbjax"}
    quadruped = {"problem": "quadruped", "engine": "rbjax"}
    gpu = "gpu-identification-nvidia-h200"
    truth, mean = f"cpu-identify-arm-truth-{CORE}", lambda found: sum(found) / len(found)
    out: dict[str, Figure] = {
        "truth.inside": Number(truth, "inside", best=mean, scale=100 / 8),
        "truth.seconds": Number(truth, "seconds", digits=2),
        "sysid.arm.error": Number(file, "error", arm, digits=1),
        "sysid.arm.again": Number(file, "again_s", arm, digits=2),
        "sysid.arm.mujoco": Number(file, "again_s", arm | {"engine": "mujoco.sysid"}, digits=2),
        "sysid.quadruped.inside": Number(file, "inside", quadruped),
        "sysid.quadruped.unknowns": Number(file, "unknowns", quadruped),
        "sysid.quadruped.cpu": Number(file, "first_cpu_s", quadruped, digits=2),
        "sysid.quadruped.gpu": Number(gpu, "first_s", quadruped, digits=2),
        "sysid.quadruped.gpu.again": Number(gpu, "again_s", quadruped, digits=2),
        "sysid.jacobian": Number(f"gpu-sysid-jacobian-{H100}", "ratio", digits=2),
    }
    for robot in ("double_pendulum", "cart_pole", "arm7"):
        out[f"sysid.intervals.{robot}"] = Number(
            f"cpu-intervals-{robot}-{XEON}", "coverage", scale=100
        )
    return out


def _real() -> dict[str, Figure]:
    legs, half = f"cpu-legs-in-the-air-{CORE}", {"part": "half"}
    pendulums, motors = f"cpu-pendulum-data-{CORE}", f"cpu-double-pendulum-motors-{CORE}"
    out: dict[str, Figure] = {
        "legs.nominal": Number(legs, "unseen", half | {"model": "nominal"}),
        "legs.usual": Number(legs, "unseen", half | {"model": "49 numbers"}, digits=2),
        "legs.curves": Number(legs, "unseen", half | {"model": "curves of (12, 8)"}, digits=2),
        "pendulums.better": Rows(
            pendulums, lambda row: _piece(row) and row["found 1.5"] < row["published 1.5"]
        ),
        "pendulums.pieces": Rows(pendulums, _piece),
    }
    for name in ("single", "double", "triple"):
        for who in ("found", "published"):
            out[f"pendulums.{name}.{who}"] = Number(
                pendulums, f"{who} 1.5", {"pendulum": name, "piece": "median"}, digits=2
            )
    for design in ("A.0", "C.1"):
        for who, model in (("fitted", "fitted to the other runs"), ("published", "published")):
            where = {"design": design, "cutoff": 4.0, "model": model}
            for joint in ("shoulder", "elbow"):
                out[f"motors.{design}.{who}.{joint}"] = Number(
                    motors, f"R2 {joint}", where, digits=2 if joint == "shoulder" else 3
                )
    floors, encoders = f"cpu-slip_by_floor-{CORE}", {"model": "encoders"}
    for floor in ("table", "brown", "gray", "green"):
        where = {"floor": floor}
        out[f"floors.{floor}.encoders"] = Number(floors, "mean", where | encoders, digits=2)
        fitted = where | {"model": ("up to harmonic 1", "up to harmonic 5, 1 with speed")}
        out[f"floors.{floor}.mean"] = Number(floors, lambda row: abs(row["mean"]), fitted, digits=2)
    return out


OUTLIERS = {"wrong": "5 % outliers"}
WRONG = f"cpu-wrong-data-leg-{CORE}"
FIGURES = _simulated() | _real() | {
    "wrong.worst": Number(WRONG, "error", digits=2),
    "wrong.huber": Ratio(
        Number(WRONG, "error", OUTLIERS | {"loss": "squares"}),
        Number(WRONG, "error", OUTLIERS | {"loss": "huber"}),
        2,
    ),
    "wrong.corrected": Number(
        WRONG.replace("leg", "quadruped"), "error, corrected", scale=100, digits=1
    ),
}  # fmt: skip
