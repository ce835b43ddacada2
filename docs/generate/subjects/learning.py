"""Environments and training."""

from docs.generate.tables import Column as C
from docs.generate.tables import Pivot, Table

TABLES = {
    "environments": Pivot(
        ("gpu-environments-*",),
        (C("task"), C("decimation", "physics steps a control step")),
        "what",
        C("M/s median", "million a second"),
        order=("step", "rollout"),
    ),
    "training": Table(
        ("training-*",),
        (
            C("task"),
            C("algorithm"),
            C("seed"),
            C("steps"),
            C("seconds", "seconds, with compiling"),
            C(lambda row: row["steps"] / row["seconds"] / 1e6, "million steps a second, all in", 2),
            C(lambda row: row["evaluation"]["return"], "return"),
            C(lambda row: row["evaluation"]["std"], "its standard deviation", 2),
            C(lambda row: row["evaluation"]["episodes"], "episodes"),
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
