"""Environments and training."""

from docs.generate.measured import evaluation
from docs.generate.subjects.tables import Column as C
from docs.generate.subjects.tables import Pivot, Table

TABLES = {
    "environments": Pivot(
        ("gpu-environments-nvidia-h200*", "gpu-environments-nvidia-h100*"),
        (C("task"), C("decimation", "physics steps a control step"), C("batch")),
        "what",
        C("M/s median", "million a second"),
        order=("step", "unroll", "rollout"),
    ),
    "training": Table(
        ("training-*",),
        (
            C("task"),
            C(
                lambda row: ", ".join(f"{k}={x}" for k, x in row.get("options", {}).items()),
                "options",
            ),
            C("algorithm"),
            C("seed"),
            C("steps"),
            C("seconds", "seconds, with compiling"),
            C(lambda row: row["steps"] / row["seconds"] / 1e6, "million steps a second, all in", 2),
            C(lambda row: evaluation(row)["return"], "return"),
            C(lambda row: evaluation(row)["std"], "its standard deviation", 2),
            C(lambda row: evaluation(row)["episodes"], "episodes"),
            C(lambda row: row.get("judge") or row["task"], "of the task"),
        ),
    ),
    "gait": Table(
        ("gait-*",),
        (
            C("command"),
            C("robots", "robots that do not fall, of 16"),
            C("asked", "asked, m/s or rad/s", 2),
            C("reached", "reached", 2),
            C("diagonal", "correlation of the thighs of a diagonal", 2),
            C("neighbours", "of neighbours", 2),
        ),
        "python -m benchmarks.envs.gait FOLDER",
    ),
    "policies": Table(
        ("policies-*",),
        (
            C("task"),
            C("trained with"),
            C("options", "options of the evaluation"),
            C("physics"),
            C("episodes"),
            C("return"),
            C("std", "its standard deviation", 2),
            C("upright", "% upright to the end", 3, 100),
        ),
        "python -m benchmarks.envs.policies FOLDER",
        sort=lambda row: (row["task"], row["trained with"], row["options"], row["physics"]),
        optional=True,
    ),
    "training on several GPUs": Table(
        ("gpu-devices-*",),
        (
            C("task"),
            C("devices", "GPUs"),
            C("num_envs", "robots"),
            C("M samples/s", "million samples a second"),
            C("over one", "over one GPU"),
        ),
    ),
    "policy through the dynamics": Table(
        ("gpu-policy-*",),
        (
            C("method"),
            C("seed"),
            C("iterations"),
            C("batch"),
            C("seconds", "seconds, with compiling"),
            C("M steps", "million steps"),
            C("success"),
        ),
        "python -m benchmarks.gpu.policy",
    ),
}
