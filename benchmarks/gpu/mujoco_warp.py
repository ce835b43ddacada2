"""MuJoCo Warp: steps a second with contacts of the robots of `gpu.contact`, and forward dynamics.

    pip install mujoco-warp==4.0.0
    python -m benchmarks.gpu.mujoco_warp --robots humanoid humanoid_feet FILE.xml
    python -m benchmarks.gpu.mujoco_warp --robots --forward panda humanoid g1

States, controls and number of steps are those of `gpu.contact`. "converged" has the options of the
file, "4 Newton steps" those of `gpu.contact --parts mjx`. Models and states of the forward dynamics
are those of `gpu.mjx`. On a GPU all calls are one CUDA graph. It writes
results/gpu-warp-contact-<robot>-<device> and results/gpu-warp-forward-<robot>-<device>.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from benchmarks.cases.standing import on_floor, random_controls, settled
from benchmarks.shared.gpu_timing import finish
from benchmarks.shared.robots import actuated, states
from benchmarks.shared.warp_states import assign

STEPS, RUNS = 50, 7
#: calls of forward dynamics in a row, as in `gpu_timing`
CALLS = 5
KINDS = ("converged", "4 Newton steps")
#: room for contacts and rows of a world, above the most that a robot has
CONTACTS, ROWS = 64, 256


def measured(
    reset: Callable[[], None], call: Callable[[], None], calls: int, batch: int
) -> dict[str, Any]:
    """The columns about time of `calls` calls after `reset`."""
    begin = time.perf_counter()
    reset()
    call()  # compiles
    run = several = lambda: [call() for _ in range(calls)]
    if wp.get_device().is_cuda:
        with wp.ScopedCapture() as capture:
            several()
        run = lambda: wp.capture_launch(capture.graph)  # noqa: E731
    wp.synchronize()
    compile_s = time.perf_counter() - begin
    times = []
    for _ in range(RUNS):
        reset()
        wp.synchronize()
        begin = time.perf_counter()
        run()
        wp.synchronize()
        times.append(time.perf_counter() - begin)
    work, median = batch * calls / 1e6, float(np.median(times))
    return {
        "engine": "MuJoCo Warp", "batch": batch,
        "version": importlib.metadata.version("mujoco-warp"), "lower_s": 0.0,
        "compile_s": compile_s, "run_s": median, "run_min_s": min(times), "repeats": RUNS,
        "M/s": work / min(times), "M/s median": work / median,
    }  # fmt: skip


def contact(name: str, batch: int, kind: str) -> dict[str, Any]:
    """Steps with contacts."""
    m = on_floor(name)
    q, v = settled(m, batch)
    if kind == "4 Newton steps":
        m.opt.solver, m.opt.iterations, m.opt.ls_iterations = mujoco.mjtSolver.mjSOL_NEWTON, 4, 8
    model = mjw.put_model(m)
    data = mjw.make_data(m, nworld=batch, nconmax=CONTACTS, njmax=ROWS)
    ctrl = random_controls(m, np.random.default_rng(1), batch).astype(np.float32)

    def reset() -> None:
        data.qpos.assign(q.astype(np.float32))
        data.qvel.assign(v.astype(np.float32))
        data.qacc_warmstart.zero_()
        data.time.zero_()
        if m.nu:
            data.ctrl.assign(ctrl)

    times = measured(reset, lambda: mjw.step(model, data), STEPS, batch)
    return {
        "what": kind, "robot": Path(name).stem, **times,
        "rows a world": float(data.nefc.numpy().mean()),
        "finite": bool(np.isfinite(data.qpos.numpy()).all()),
    }  # fmt: skip


def forward(name: str, batch: int) -> dict[str, Any]:
    """Evaluations of forward dynamics, without contacts and constraints."""
    m = actuated(name)
    model, data = mjw.put_model(m), mjw.make_data(m, nworld=batch, nconmax=1, njmax=1)
    q, v, tau = (np.resize(x, (batch, x.shape[1])) for x in states(m, min(batch, 4096)))

    times = measured(
        lambda: assign(data, q, v, tau), lambda: mjw.forward(model, data), CALLS, batch
    )
    finite = bool(np.isfinite(data.qacc.numpy()).all())
    return {"what": "forward", "robot": name, **times, "finite": finite}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", nargs="*", default=["humanoid", "humanoid_feet"])
    parser.add_argument("--batches", nargs="+", type=int, default=[8192, 65536])
    parser.add_argument("--forward", nargs="*", default=["panda", "humanoid", "g1"])
    opts = parser.parse_args()
    for robot in opts.robots:
        rows = [contact(robot, batch, kind) for batch in opts.batches for kind in KINDS]
        finish(f"gpu-warp-contact-{Path(robot).stem}", rows)
    for robot in opts.forward:
        rows = [forward(robot, batch) for batch in (*opts.batches, 4 * max(opts.batches))]
        finish(f"gpu-warp-forward-{robot}", rows)
