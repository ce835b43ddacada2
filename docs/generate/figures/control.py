"""Optimal control, predictive control, inverse kinematics, swing-ups, searches of paths."""

from __future__ import annotations

from docs.generate import measured
from docs.generate.figures.kinds import Figure, Number, Ratio

H100, H200, CORE = "nvidia-h100-80gb-hbm3", "nvidia-h200", "amd-epyc"
PROBLEMS = {
    "arm-wrapped": "arm, wrapped angles", "arm": "arm", "arm-rest": "arm to rest",
    "double-pendulum": "double pendulum by DDP", "quadrotor": "quadrotor", "cart-pole": "cart-pole",
}  # fmt: skip


def _crocoddyl() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    counts = f"cpu-iteration-counts-{CORE}"
    for short, problem in PROBLEMS.items():
        where, name = {"problem": problem}, f"control.{short}"
        out[f"{name}.as-good"] = Number(counts, "to their cost", where)
        out[f"{name}.theirs"] = Number(counts, "their iterations", where)
    bounded = {"problem": "bounded quadrotor"}
    out["control.bounded.six-digits"] = Number(counts, "to 6 digits", bounded)
    out["control.bounded.theirs"] = Number(counts, "theirs to 6 digits", bounded)
    pendulum = {"problem": PROBLEMS["double-pendulum"]}
    out["control.double-pendulum.cheaper"] = Ratio(
        Number(counts, "their cost", pendulum), Number(counts, "cost", pendulum), 2
    )
    for problem in ("arm", "quadrotor"):
        where = {"problem": problem, "engine": "rbjax"}
        out[f"control.{problem}.ratio"] = Number(f"cpu-optimal-control-{CORE}", "ratio", where,
                                                 digits=2)  # fmt: skip
    return out


def _gpu() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    for method in ("ddp", "sqp"):
        for robot, horizon in (("indy7", 16), ("indy7", 64), ("arm7", 64)):
            where = {"robot": robot, "horizon": horizon, "method": method, "what": "iteration"}
            name = f"gpu.{method}.{robot}.{horizon}"
            out[f"{name}.ms"] = Number(
                f"gpu-control-{H200}", "run_s", where | {"batch": 1}, min, 1e3, 2
            )
            if robot == "indy7":
                out[name] = Number(
                    f"gpu-control-{H200}", "M/s median", where | {"batch": 4096}, digits=2
                )
    return out


def _others() -> dict[str, Figure]:
    mpc, fast = f"cpu-mpc-{CORE}", {"iterations": 1}
    ik, all_at_once = f"cpu-inverse-kinematics-{CORE}", {"solver": "rbjax, all at once"}
    gpu_ik, dijkstra = f"gpu-inverse-kinematics-{H100}", f"cpu-grid-dijkstra-{CORE}"
    search = f"gpu-grid-dijkstra-{H200}"

    def together(row: measured.Row) -> float:
        return row["host s each"] * row["searches"] / row["all s"]

    out: dict[str, Figure] = {
        "mpc.hz": Number(mpc, "hz", fast),
        "mpc.late": Number(mpc, "late", fast),
        "mpc.ticks": Number(mpc, "ticks", fast),
        "ik.solved": Number(ik, "solved", all_at_once, scale=100),
        "ik.over-optik": Number(ik, "over the fastest peer", all_at_once, digits=2),
        "ik.gpu.f64": Number(gpu_ik, "M/s", {"dtype": "float64"}),
        "ik.gpu.f32": Number(gpu_ik, "M/s", {"dtype": "float32"}),
        "dijkstra.least": Number(dijkstra, "ratio", best=min),
        "dijkstra.most": Number(dijkstra, "ratio"),
        "dijkstra.gpu": Number(search, together),
        "policy.least": Number(f"gpu-policy-{H100}", "seconds", {"method": "actor_critic"}, min,
                               digits=2),
        "policy.most": Number(f"gpu-policy-{H100}", "seconds", {"method": "actor_critic"},
                              digits=2),
        "policy.success": Number(f"gpu-policy-{H100}", "success", {"method": "actor_critic"}, min,
                                 100),
    }  # fmt: skip
    for task in ("cart_pole", "acrobot"):
        where = {"task": task}
        out[f"swing-up.{task}"] = Number(f"gpu-swing-up-{H100}", "solved", where, scale=100)
    return out


def _riccati() -> dict[str, Figure]:
    """One recursion on an H100, ms: XLA's scan and the one parallel in time."""
    methods = {"scan": "serial, XLA", "parallel": "parallel, doubling"}
    return {
        f"riccati.{short}.{knots}": Number(
            f"riccati-{H100}", "ms", {"horizon": knots, "method": method}, digits=2
        )
        for short, method in methods.items()
        for knots in (16, 4096)
    }


def _end_states() -> dict[str, Figure]:
    """An acrobot that must end upright, by precision: how many runs converge."""
    file = f"cpu-end-states-{CORE}"
    out: dict[str, Figure] = {}
    for bits in ("f64", "f32"):
        where = {"precision": bits}
        out[f"end-states.{bits}"] = Number(file, "converged", where, sum)
        out[f"end-states.{bits}.runs"] = Number(file, "guesses", where, sum)
    return out


FIGURES = _crocoddyl() | _gpu() | _others() | _riccati() | _end_states()
