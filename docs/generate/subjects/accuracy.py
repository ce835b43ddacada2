"""Accuracy of rbjax and MJX against MuJoCo C in f64 and f32, and of libraries of rotations."""

from docs.generate.subjects.tables import Column as C
from docs.generate.subjects.tables import Pivot, Table

TABLES = {
    "f64 and f32": Table(
        ("accuracy-amd-*",),
        (
            C("model"),
            C("nv", "dof"),
            C("f64 max", "f64, worst", 2),
            C("f64 worst", "of"),
            C("f32 median", "f32, median", 2),
            C("f32 max", "f32, worst", 2),
            C("condition", digits=2),
        ),
        "python -m benchmarks.accuracy.against_mujoco --full",
        sort=lambda row: -row["f64 max"],
    ),
    "f32 on a GPU": Table(
        ("gpu-accuracy-*",),
        (
            C("model"),
            C("nv", "dof"),
            C("rbjax median", digits=2),
            C("MJX median", digits=2),
            C("rbjax max", "rbjax worst", 2),
            C("MJX max", "MJX worst", 2),
        ),
        "python -m benchmarks.accuracy.against_mujoco_gpu",
        sort=lambda row: -(row.get("MJX median") or 0),
    ),
    "f32 of MuJoCo Warp": Table(
        ("accuracy-warp-*",),
        (C("model"), C("nv", "dof"), C("on"), C("median", digits=2), C("max", "worst", 2)),
        "python -m benchmarks.accuracy.warp_float32",
    ),
    "libraries of rotations": Pivot(
        ("rotation-libraries-*",),
        (C("what", ""), C("where")),
        "library",
        C("error", "the worst error", 2),
        "python -m benchmarks.accuracy.rotation_libraries",
        lambda row: row["error"] is not None,
        order=("rbjax", "scipy", "pytransform3d", "jaxlie"),
    ),
    "attitudes": Table(
        ("tumbling-map-*",),
        (
            C("name", "representation"),
            C("family"),
            C("share_above_1e-10", "share above 1e-10", 2),
            C("worst_rad", "worst, rad", 2),
            C("median_rad", "median, rad", 2),
            C("singular"),
        ),
        "python -m benchmarks.maps.tumbling_map",
    ),
}
