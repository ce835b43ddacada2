"""Forward dynamics on an accelerator: the drivers under XLA, and the kernels, f32, batch last.

`python -m benchmarks.gpu_forward --robots panda` writes results/gpu-forward-<robot>-<device>.json.
`--tag tune` tries more shapes of the kernel.
"""

from __future__ import annotations

import jax
import numpy as np

import rbjax as rb
from benchmarks.gpu_timing import finish, options, timed
from benchmarks.robots import actuated, as_model, batch, exact, relative
from rbjax.dynamics import kernel

MILLION = 1_048_576
SIZES = (65_536, MILLION)


def variants(model, tuning: bool) -> dict:
    """Name -> (function of (model, q, v, tau) with the batch last, closed over?, batches)."""
    out = {}

    def by_vmap(m, q, v, tau):
        f = jax.vmap(rb.forward_dynamics, in_axes=(None, 0, 0, 0))
        return f(m, q.T, v.T, tau.T).T

    def xla(m, q, v, tau):
        from rbjax.dynamics.aba import aba
        from rbjax.dynamics.drivers import driver

        d = driver(m.replace(driver="rolled"), q.dtype)
        return d.pack(aba(d, d.joints(q, v), d.lanes(tau), d.prepared.gravity)[0], tau)

    def kernels(name, plan, closed, sizes):
        out[name] = (lambda m, *x: kernel.forward_dynamics(m, *x, how=plan), closed, sizes)

    kernels("kernel", None, True, (16_384, *SIZES))
    kernels("kernel, model an argument", None, False, SIZES)
    out["rb.forward_dynamics under vmap"] = (by_vmap, True, SIZES)
    out["rolled under XLA, no kernel"] = (xla, True, SIZES)
    if tuning:
        for per, block, warps in (
            (2, 256, 4), (4, 256, 4), (1, 512, 4), (2, 512, 4), (2, 512, 8), (2, 256, 8),
            (4, 128, 4), (8, 64, 1), (4, 256, 8),
        ):  # fmt: skip
            plan = kernel.Plan("rolled", block, warps, 132 * per)
            kernels(f"kernel block{block} warps{warps} programs{132 * per}", plan, True, SIZES)
    return out


def bench(name: str, batches, tuning: bool) -> list[dict]:
    m = actuated(name)
    model = as_model(m)
    states, want = exact(m, 256)
    rows: list[dict] = []
    for what, (run, closed, sizes) in variants(model, tuning).items():
        for size in batches or sizes:
            q, v, tau, _ = batch(m, size, last=True)
            row = {"what": "forward", "robot": name, "engine": what, "batch": size}
            if closed:
                row = timed(row, lambda *x, f=run: f(model, *x), q, v, tau, work=size)
            else:
                row = timed(row, run, model, q, v, tau, work=size)
            rows.append(row)
            if "compile_s" not in row:
                break
        if "compile_s" in rows[-1]:
            given = (np.ascontiguousarray(x.T) for x in states[:3])
            error = relative(jax.jit(lambda *x, f=run: f(model, *x))(*given).T, want)
            rows[-1] |= {"error median": float(np.median(error)), "error max": error.max()}
            print("error", name, what, f"{np.median(error):.2e} {error.max():.2e}", flush=True)
    return rows


if __name__ == "__main__":
    opts = options(__doc__)
    for robot in opts.robots:
        finish(f"gpu-forward-{robot}", bench(robot, opts.batches, bool(opts.tag)))
