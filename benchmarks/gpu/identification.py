"""The quadruped in the air with 49 unknowns, identified on a GPU: all included, and what it is of.

`python -m benchmarks.gpu.identification [--data FOLDER]` writes
results/gpu-identification-<device>.json. On the processor beside it:
`JAX_PLATFORMS=cpu python -m benchmarks.cpu.identification quadruped`.

first_s is the first call of `identify`, with tracing and compiling, in f64. Of it are trace_s,
lower_s (our program and NVRTC), compile_s (XLA), as JAX counts them, and run_s, the rest. again_s
is a second call from another first guess. residual_s and triangle_s are one evaluation of r and one
of the Jacobian with its factor R.

What decides the time: a recording is 8,000 periods of six steps of Runge-Kutta, one after the
other, so 192,000 evaluations of the dynamics of a leg. Legs (4) and directions (13) are 52 threads,
each as slow as one thread is; 32 segments of the motion side by side
(`rbjax.sysid.simulation.parallel_in_time`) are 1,664, and three or four sweeps make one motion of
them. A motion at once took 0.39 s and its slopes 1.57 s.
"""

from __future__ import annotations

import argparse
import time
from collections import Counter
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402

from benchmarks.cases import problems  # noqa: E402
from benchmarks.cpu.identification import guessed_again  # noqa: E402
from benchmarks.shared.timing import markdown_table, save  # noqa: E402
from rbjax.sysid import identify  # noqa: E402

COLUMNS = (
    "problem", "unknowns", "evaluations", "first_s", "trace_s", "lower_s", "compile_s", "run_s",
    "again_s", "residual_s", "triangle_s", "sigmas", "inside",
)  # fmt: skip
STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "trace_s",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower_s",
    "/jax/core/compile/backend_compile_duration": "compile_s",
}
spent: Counter[str] = Counter()


def listen(event: str, seconds: float, **_: Any) -> None:
    if event in STAGES:
        spent[STAGES[event]] += seconds


def best_of(f: Any, runs: int = 3) -> float:
    times = []
    for _ in range(runs):
        start = time.perf_counter()
        jax.block_until_ready(f())
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--data", type=Path, default=problems.GO2, help="the quadruped's files")
    problems.GO2 = parser.parse_args().data
    problem = problems.quadruped()
    other = guessed_again(problem)
    jax.monitoring.register_event_duration_secs_listener(listen)
    spent.clear()
    start = time.perf_counter()
    found = identify(problem.setup, problem.run, problem.unknowns, **problem.how)
    first = time.perf_counter() - start
    stages = {name: spent[name] for name in STAGES.values()}
    row: dict[str, Any] = {
        "problem": "quadruped", "engine": "rbjax", "unknowns": len(problem.truth),
        "evaluations": found.evaluations, "first_s": first, **stages,
        "run_s": first - sum(stages.values()), "ok": found.success,
    }  # fmt: skip
    p, sigma = np.array([*found.values.values()]), found.estimates.sigma
    intervals = [found.estimates.interval(name) for name in found.values]
    row["sigmas"] = float(np.abs((p - problem.truth) / sigma).max())
    within = [x.low <= t <= x.high for x, t in zip(intervals, problem.truth, strict=True)]
    row["inside"] = int(sum(within))
    print(row, flush=True)
    start = time.perf_counter()
    identify(other.setup, other.run, other.unknowns, **other.how)
    row["again_s"] = time.perf_counter() - start
    row["residual_s"] = best_of(lambda: found.error.residuals(p))
    row["triangle_s"] = best_of(lambda: found.error.triangle(p))
    print(markdown_table([row], COLUMNS))
    save("gpu-identification", [row])


if __name__ == "__main__":
    main()
