"""Forward dynamics on an accelerator: the drivers under XLA, and the kernels, f32, batch last.

`python -m benchmarks.gpu_forward --robots panda` writes results/gpu-forward-<robot>-<device>.json.
"""

from __future__ import annotations

import jax
import numpy as np

from benchmarks.gpu_mjx import exact, relative
from benchmarks.gpu_models import batch, pair
from benchmarks.gpu_timing import finish, options, timed
from rbjax.dynamics import kernel
from rbjax.dynamics.forward import acceleration

MILLION = 1_048_576
SIZES = (65_536, MILLION)


def variants(model, tuning: bool) -> dict:
    """Name -> (function of (model, q, v, tau), closed over?, batches)."""
    small = model.nv <= 9
    out = {
        "xla unrolled": (acceleration, "unrolled", True, SIZES if small else ()),
        "xla rolled": (acceleration, "rolled", True, SIZES),
    }

    def kernels(driver, closed, sizes, **how):
        plan = kernel.Plan(driver, **how)
        words = " ".join(f"{k}{v}" for k, v in how.items())
        name = f"kernel {driver}{'' if closed else ' traced'} {words}".strip()

        def run(m, q, v, tau):
            return kernel.forward_dynamics(m, q, v, tau, how=plan)

        out[name] = (run, "auto", closed, sizes)

    both = (4096, *SIZES)
    if small:
        kernels("unrolled", True, both, block=128, warps=4)
        kernels("unrolled", False, SIZES, block=128, warps=4)
        if tuning:
            kernels("unrolled", True, (MILLION,), block=64, warps=2)
            kernels("unrolled", True, (MILLION,), block=32, warps=1)
    kernels("rolled", True, both, block=128, warps=4, programs=132 * 4)
    kernels("rolled", False, SIZES, block=128, warps=4, programs=132 * 4)
    if tuning:
        for per, block, warps in (
            (2, 256, 4), (4, 256, 4), (8, 256, 4), (1, 512, 4), (2, 512, 4), (2, 256, 2),
            (4, 128, 2), (8, 64, 1), (16, 32, 1), (2, 128, 4),
        ):  # fmt: skip
            kernels("rolled", True, SIZES, block=block, warps=warps, programs=132 * per)
    return out


def bench(name: str, batches, tuning: bool) -> list[dict]:
    m, model = pair(name)
    states, want = exact(m)
    rows: list[dict] = []
    for what, (run, driver, closed, sizes) in variants(model, tuning).items():
        robot = model.replace(driver=driver)
        for size in batches or sizes:
            q, v, tau, _ = batch(m, size, last=True)
            row = {"what": "forward", "robot": name, "engine": what, "batch": size}
            if closed:
                row = timed(row, lambda *x, f=run, r=robot: f(r, *x), q, v, tau, work=size)
            else:
                row = timed(row, run, robot, q, v, tau, work=size)
            rows.append(row)
            if "compile_s" not in row:
                break
        if "compile_s" in (rows[-1] if rows else {}):
            q, v, tau, _ = (np.ascontiguousarray(x.T) for x in states)
            got = jax.jit(lambda *x, f=run, r=robot: f(r, *x))(q, v, tau)
            error = relative(np.asarray(got, np.float64).T, want)
            rows[-1]["error median"] = float(np.median(error))
            rows[-1]["error max"] = float(error.max())
            print("error", name, what, f"{np.median(error):.2e} {error.max():.2e}", flush=True)
    return rows


if __name__ == "__main__":
    opts = options(__doc__)
    for robot in opts.robots:
        finish(f"gpu-forward-{robot}", bench(robot, opts.batches, bool(opts.tag)))
