"""Motion without contacts on GPUs, f32: ours the median of runs, other engines the fastest run."""

from __future__ import annotations

from docs.generate import measured
from docs.generate.figures.kinds import Cell, Figure, Number, Ratio

ROBOTS = ("panda", "humanoid", "g1")
H200 = "nvidia-h200"
#: part of the pages -> the row of ours, and of MJX
PARTS = {
    "forward": ("forward", "forward"), "rollout": ("rollout", "rollout"),
    "gradient": ("gradient by controls", "gradient"), "masses": ("gradient by masses", "gradient"),
}  # fmt: skip
OURS_ONLY = {"policy": "rollout, policy", "derivatives": "forward dynamics derivatives"}


def _seconds(row: measured.Row) -> float:
    """From the trace to the program."""
    return row["lower_s"] + row["compile_s"]


def _robots() -> dict[str, Figure]:
    out: dict[str, Figure] = {}
    for robot in ROBOTS:
        ours, theirs = f"gpu-threads-{robot}-{H200}", f"gpu-mjx-{robot}-{H200}"
        for part, (what, peer) in PARTS.items():
            name, mjx = f"gpu.{part}.{robot}", {"what": peer, "engine": "mjx"}
            out[name] = Number(ours, "M/s median", {"what": what})
            out[f"{name}.mjx"] = Number(theirs, "M/s", mjx)
            out[f"{name}.over-mjx"] = Ratio(out[name], out[f"{name}.mjx"])
        for part, what in OURS_ONLY.items():
            out[f"gpu.{part}.{robot}"] = Number(ours, "M/s median", {"what": what})
        forward = {"what": "forward"}
        warp = f"gpu-warp-forward-{robot}-{H200}"
        if warp in measured.names():
            out[f"gpu.forward.{robot}.warp"] = Number(warp, "M/s", forward)
        out[f"gpu.compile.{robot}"] = Number(ours, _seconds, forward, min, digits=2)
        out[f"gpu.compile.{robot}.mjx"] = Number(
            theirs, _seconds, forward | {"engine": "mjx"}, min, digits=2
        )
    return out


def _elements() -> dict[str, Figure]:
    """A force of a user on a quadruped: the rate with it over the rate without it."""
    file = f"elements-quadruped-{H200}"

    def rate(what: str, run: str) -> Number:
        return Number(file, "M/s median", {"what": what, "run": run})

    return {
        f"gpu.wind.{run}": Ratio(rate("a wind", run), rate("alone", run))
        for run in ("rollout", "gradient")
    }


def _precision() -> dict[str, Figure]:
    """MJX's time over ours for an error of 1e-6: scenes with the least and the largest ratio."""
    page = "benchmarks/work-precision.md"
    scenes = {
        "h200.least": ("humanoid in flight", "H200"),
        "h200.most": ("heavy top, 100 rad/s", "H200"),
        "core.least": ("7-joint arm with servos", "CPU, one core"),
        "core.most": ("free tumbling body", "CPU, one core"),
    }
    return {f"precision.{name}": Cell(page, row, "mjx/rbjax") for name, row in scenes.items()}


def _sharded(what: str) -> Number:
    return Number(f"gpu-sharded-humanoid-{H200}", "over one", {"what": what})


FIGURES = _robots() | _elements() | _precision() | {
    "gpu.two.rollout": _sharded("rollout"),
    "gpu.two.gradient": _sharded("gradient by masses and controls"),
}  # fmt: skip
