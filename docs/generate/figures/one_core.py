"""Algorithms, calls and compile times on one core, SciPy's rotations, and sizes of registries."""

from __future__ import annotations

from docs.generate.figures.kinds import Count, Entries, Figure, Number, Rate, Ratio, Rows

CORE, XEON = "amd-epyc", "intel-r-xeon-r-processor"
ROBOTS = ("panda", "humanoid", "g1")
ALGORITHMS = {"forward": "forward dynamics", "rnea": "RNEA", "crba": "CRBA",
              "fk": "forward kinematics"}  # fmt: skip
DERIVATIVES = {
    "forward": "derivatives of forward dynamics", "inverse": "derivatives of inverse dynamics",
}  # fmt: skip


def _calls() -> dict[str, Figure]:
    """One call, one robot's rollout, and compile times, by robot."""
    out: dict[str, Figure] = {}
    call, one = f"cpu-one-call-{CORE}", f"cpu-one-robot-{CORE}"
    stages, peers = f"cpu-compile-stages-{CORE}", f"cpu-one-call-peers-{CORE}"
    for robot in ROBOTS:
        row = {"robot": robot}
        name = f"cpu.call.{robot}"
        out[name] = Number(call, "compiled_ns", row, min, 1e-3, 2)
        out[f"{name}.mujoco"] = Number(call, "mujoco_ns", row, min, 1e-3, 2)
        out[f"{name}.jit"] = Number(call, "jit_ns", row, min, 1e-3, 2)
        out[f"{name}.over-mujoco"] = Number(call, "over_mujoco", row, digits=2)
        for engine in ("mjx", "warp") if robot == "humanoid" else ("mjx", "warp", "pinocchio"):
            out[f"{name}.{engine}"] = Number(peers, f"{engine}_ns", row, min, 1e-3, 2)
        out[f"{name}.over-empty"] = Number(call, "jit_over_empty", row)
        step = row | {"what": "rollout, a step"}
        out[f"cpu.step.{robot}"] = Number(one, "llvm_us", step, digits=2)
        out[f"cpu.step.{robot}.over-mujoco"] = Number(one, "over_mujoco", step, digits=2)
        out[f"cpu.step.{robot}.over-xla"] = Number(one, "speedup", step, digits=2)
        batch = row | {"what": "forward dynamics, batch first, a sample"}
        out[f"cpu.batch.{robot}.over-xla"] = Number(one, "speedup", batch, digits=2)
        compiling = f"cpu-compile-{robot}-{XEON}"
        out[f"cpu.compile.{robot}"] = Number(compiling, "rbjax s", row, min, 1, 2)
        out[f"cpu.compile.{robot}.mjx"] = Number(compiling, "MJX s", row, min, 1, 2)
        out[f"cpu.compile.{robot}.over-mjx"] = Number(compiling, "ratio", row, digits=2)
        stage = row | {"what": "forward dynamics"}
        out[f"cpu.stages.{robot}"] = Number(
            f"cpu-compile-stages-{CORE}", "seconds", stage, digits=2
        )
    gradient = {"what": "gradient of 100 steps by the model", "robot": "arm7"}
    out["cpu.gradient.over-xla"] = Number(one, "speedup", gradient, digits=2)
    out["cpu.stages.gradient"] = Number(stages, "seconds", gradient, digits=2)
    simulate = {"what": "simulate, 1 s, tolerance 1e-8"}
    out["cpu.simulate.over-xla"] = Number(one, "speedup", simulate, digits=2)
    out["cpu.forms"] = Number(f"cpu-forms-{CORE}", "plain over fastest", digits=2)
    out["cpu.forms.functions"] = Count(f"cpu-forms-{CORE}", "function")
    return out


def _algorithms() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    file = f"cpu-algorithms-{CORE}"
    for robot in ("panda", "g1"):
        for short in ("forward", "rnea", "crba"):
            where = {"robot": robot, "algorithm": ALGORITHMS[short], "engine": "rbjax float64",
                     "driver": "auto"}  # fmt: skip
            name = f"cpu.{short}.{robot}"
            out[name] = Number(file, "ns", where, min, 1e-3, 2)
            out[f"{name}.pinocchio"] = Number(file, "Pinocchio's ns", where, min, 1e-3, 2)
            out[f"{name}.over-pinocchio"] = Ratio(out[f"{name}.pinocchio"], out[name], 2)
        out[f"cpu.rate.{robot}"] = Rate(out[f"cpu.forward.{robot}"])
        out[f"cpu.rate.{robot}.pinocchio"] = Rate(out[f"cpu.forward.{robot}.pinocchio"])
    for robot in ROBOTS:
        for bits in (64, 32):
            where = {"robot": robot, "bits": bits,
                     "algorithm": tuple(ALGORITHMS[x] for x in ("rnea", "crba", "fk"))}  # fmt: skip
            out[f"cpu.xla.{robot}.f{bits}"] = Number(
                f"cpu-back-ends-{CORE}", "speedup", where, min, digits=2
            )
    for robot in ("panda", "humanoid"):
        for short, algorithm in DERIVATIVES.items():
            where = {"robot": robot, "algorithm": algorithm, "bits": 64}
            out[f"cpu.older.{short}.{robot}"] = Number(
                f"cpu-older-{CORE}", "speedup", where, digits=2
            )
    return out


def _rotations() -> dict[str, Figure]:
    """SciPy's time over ours, a million rotations, f64."""
    file, where = f"cpu-rotations-{CORE}", {"cores": "one", "dtype": "f64"}
    others = Count(file, "operation", where)
    return {
        "cpu.rotations.operations": others,
        "cpu.rotations.matrix": Number(file, "ratio", where | {"operation": "as_matrix"}, digits=2),
        "cpu.rotations.least": Number(
            file,
            lambda row: row["ratio"] if row["operation"] != "as_matrix" else float("inf"),
            where,
            min,
            digits=2,
        ),
        "cpu.rotations.most": Number(file, "ratio", where),
    }


def _integrators(engine: str) -> Rows:
    """The number of integrators that an engine steps with."""
    return Rows(
        f"work-peer-integrators-{CORE}", lambda row: row["engine"] == engine and "error" in row
    )


FIGURES = _calls() | _algorithms() | _rotations() | {
    "count.formulations": Entries("constraints.formulations"),
    "count.solvers": Entries("solvers.all"),
    "count.representations": Entries("rotations.representations"),
    "count.body": Entries("body.formulations"),
    "count.integrators.mjx": _integrators("mjx"),
    "count.integrators.warp": _integrators("MuJoCo Warp"),
}  # fmt: skip
