"""Beams: comparison with Exudyn and of formulations, a reduced basis, times, single precision."""

from docs.generate.subjects.tables import Column as C
from docs.generate.subjects.tables import Pivot, Table

TABLES = {
    "exudyn": Table(
        ("flexible-exudyn-*",),
        (
            C("scene"),
            C("formulation"),
            C("segments"),
            C("coordinates"),
            C("error", digits=2),
            C("run_s", "run, s"),
        ),
    ),
    "beam formulations": Pivot(
        ("flexible-reference-accuracy-*",),
        (C("scene"), C("formulation")),
        "segments",
        C("error", digits=2),
        "python -m benchmarks.flexible.reference_accuracy",
        order=(4, 8, 16, 32),
        optional=True,
    ),
    "reduced bend": Table(
        ("flexible-reduced-bend-*",),
        (
            C("slenderness"),
            C("snapshots"),
            C("coordinates"),
            C("error", "under F", digits=2),
            C("within 30 degrees", digits=2),
        ),
        "python -m benchmarks.flexible.reduced_bend",
        optional=True,
    ),
    "one call of beams": Table(
        ("cpu-one-call-beams-*",),
        (
            C("robot"),
            C("nv", "coordinates"),
            C("compiled_ns", "rb.compile, us", scale=1e-3),
            C("jit_ns", "jax.jit, us", scale=1e-3),
            C("compile_s", "compiling, s", digits=2),
        ),
        "python -m benchmarks.cpu.one_call_beams",
        optional=True,
    ),
    "gpu beams": Pivot(
        ("gpu-flexible-*",),
        (C("on"), C("robot"), C("nv", "coordinates"), C("dtype")),
        "run",
        C("M/s median", "million a second"),
        "python -m benchmarks.gpu.flexible",
        optional=True,
    ),
    "cable in f32": Table(
        ("accuracy-cable-float32-*",),
        (
            C("integrator"),
            C("dt", "step, s"),
            C("after 5 s", digits=1),
            C("after 10 s", digits=1),
            C("largest", digits=1),
        ),
        "python -m benchmarks.accuracy.cable_float32",
        optional=True,
    ),
}
