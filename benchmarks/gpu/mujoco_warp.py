"""MuJoCo Warp on the robots of `gpu.contact`: steps a second with contacts.

    pip install mujoco-warp==4.0.0
    python -m benchmarks.gpu.mujoco_warp --robots humanoid humanoid_feet FILE.xml

States, controls and number of steps are those of `gpu.contact`. "converged" has the options of the
file, "4 Newton steps" those of `gpu.contact --parts mjx`. On a GPU the steps are one CUDA graph. It
writes results/gpu-warp-contact-<robot>-<device>.
"""

from __future__ import annotations

import argparse
import importlib.metadata
import time
from pathlib import Path
from typing import Any

import mujoco
import mujoco_warp as mjw
import numpy as np
import warp as wp

from benchmarks.cases.standing import on_floor, random_controls, settled
from benchmarks.shared.gpu_timing import finish

STEPS, RUNS = 50, 7
KINDS = ("converged", "4 Newton steps")
#: room for contacts and rows of a world, above the most that a robot has
CONTACTS, ROWS = 64, 256


def bench(name: str, batch: int, kind: str) -> dict[str, Any]:
    m = on_floor(name)
    q, v = settled(m, batch)
    if kind == "4 Newton steps":
        m.opt.solver, m.opt.iterations, m.opt.ls_iterations = mujoco.mjtSolver.mjSOL_NEWTON, 4, 8
    begin = time.perf_counter()
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

    def steps() -> None:
        for _ in range(STEPS):
            mjw.step(model, data)

    reset()
    mjw.step(model, data)  # compiles
    run = steps
    if wp.get_device().is_cuda:
        with wp.ScopedCapture() as capture:
            steps()
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
    work = batch * STEPS / 1e6
    return {
        "what": kind, "robot": Path(name).stem, "engine": "MuJoCo Warp", "batch": batch,
        "version": importlib.metadata.version("mujoco-warp"), "lower_s": 0.0,
        "compile_s": compile_s, "run_s": float(np.median(times)), "run_min_s": min(times),
        "repeats": RUNS, "M/s": work / min(times), "M/s median": work / float(np.median(times)),
        "rows a world": float(data.nefc.numpy().mean()),
        "finite": bool(np.isfinite(data.qpos.numpy()).all()),
    }  # fmt: skip


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--robots", nargs="+", default=["humanoid", "humanoid_feet"])
    parser.add_argument("--batches", nargs="+", type=int, default=[8192, 65536])
    opts = parser.parse_args()
    for robot in opts.robots:
        rows = [bench(robot, batch, kind) for batch in opts.batches for kind in KINDS]
        finish(f"gpu-warp-contact-{Path(robot).stem}", rows)
