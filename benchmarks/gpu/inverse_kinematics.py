"""A Panda's inverse kinematics within its joint ranges on a GPU, one search a thread.

`python -m benchmarks.gpu.inverse_kinematics [--batches ...]` solves a batch of poses that random
configurations within the ranges reach, to 1e-6 m and rad in f64, to 1e-5 in f32. A batch waits for
its last pose: `beside` is how many searches share a pose's 64 starts.
"""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
import rbjax.control
from benchmarks.shared.arm_poses import HAND, panda, reachable
from benchmarks.shared.gpu_timing import timed
from benchmarks.shared.timing import markdown_table, save

BATCHES = (16_384, 131_072, 1_048_576)
TOLERANCES = {jnp.float64: 1e-6, jnp.float32: 1e-5}
COLUMNS = ("dtype", "tolerance", "batch", "beside", "solved", "turns", "turns of the last",
           "compile_s", "run_min_s", "M/s")  # fmt: skip


def row(model: rb.Model, dtype: type, batch: int, beside: int) -> dict:
    model = model.astype(dtype)
    tolerance = TOLERANCES[dtype]
    targets = reachable(model, batch, dtype=dtype)

    def one(R: jax.Array, p: jax.Array) -> tuple:
        found = rb.control.inverse_kinematics(
            model, (R, p), body=HAND, tolerance=tolerance, side_by_side=beside
        )
        return found.q, found.success, found.iterations

    run = jax.jit(jax.vmap(one))
    q, met, turns = run(*targets)
    low, high = model.joints.range.T
    poses = jax.jit(jax.vmap(lambda q: rb.forward_kinematics(model, q)))(q)
    off = jnp.linalg.norm(poses.p[:, model.body(HAND)] - targets[1], axis=1)
    met = met & (off <= 1.1 * tolerance) & ((q >= low) & (q <= high)).all(1)
    out = {"dtype": np.dtype(dtype).name, "tolerance": tolerance, "batch": batch, "beside": beside,
           "solved": float(met.mean()), "turns": float(turns.mean()),
           "turns of the last": int(turns.max())}  # fmt: skip
    return timed(out, jax.vmap(one), *targets, work=batch)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batches", nargs="*", type=int, default=list(BATCHES))
    batches = parser.parse_args().batches
    jax.config.update("jax_enable_x64", True)
    model = panda()
    rows = [
        row(model, dtype, batch, beside)
        for dtype in TOLERANCES
        for batch in batches
        for beside in ((1, 4, 16) if batch <= 131_072 else (1,))
    ]
    print(markdown_table(rows, COLUMNS))
    save("gpu-inverse-kinematics", rows)


if __name__ == "__main__":
    main()
