"""Rollouts of 100 steps on an accelerator, and their gradients by each sample's controls.

Final states only; semi-implicit Euler, f32. `python -m benchmarks.gpu_rollout --robots panda`
writes results/gpu-rollout-<robot>-<device>.json.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp

import rbjax as rb
from benchmarks.gpu_mjx import STEPS
from benchmarks.gpu_models import batch, pair
from benchmarks.gpu_timing import finish, options, timed
from rbjax.dynamics import kernel, kernel_gradient
from rbjax.forces.applied import applied_lanes

MILLION = 1_048_576


def plans(model, tuning: bool) -> list[kernel.Plan]:
    out = [kernel.ROLLED]
    if tuning:
        out.append(kernel.Plan("rolled", block=128, warps=4, programs=528))
    if model.nv <= kernel.UNROLLED_UP_TO:
        out.insert(0, kernel.Plan("unrolled"))
    return out


def by_scan(model, q, v, ctrls, driver):
    state = rb.State(q.T, v.T)
    path = rb.rollout(model.replace(driver=driver), state, ctrls, save_every=STEPS, kernel=False)
    return path.q[:, -1].T, path.v[:, -1].T


def by_kernel(model, q, v, ctrls, plan):
    dt = jnp.asarray(model.timestep, q.dtype)
    qs, vs = kernel_gradient.rollout(
        model, q, v, ctrls, dt, applied=applied_lanes, scan=None, steps=STEPS,
        save_every=STEPS, how=plan,
    )  # fmt: skip
    return qs[-1], vs[-1]


def gradient(run):
    def of(model, q, v, ctrls):
        def loss(ctrls):
            q1, v1 = run(model, q, v, ctrls)
            return (q1 * q1).sum() + (v1 * v1).sum()

        return jax.grad(loss)(ctrls)

    return of


def bench(name: str, sizes, tuning: bool) -> list[dict]:
    m, model = pair(name)
    rows: list[dict] = []
    runs = []
    for plan in plans(model, tuning):
        words = f"kernel {plan.driver} block{plan.block} warps{plan.warps} programs{plan.programs}"
        runs.append((words, lambda *x, p=plan: by_kernel(*x, p), "last"))
    scanned = "unrolled" if model.nv <= 9 else "rolled"
    runs.append((f"scan {scanned}", lambda *x: by_scan(*x, scanned), "first"))
    for engine, run, order in runs:
        many = (65_536, MILLION if model.nv <= 9 else 262_144)
        small = (65_536, 262_144) if tuning or model.nv <= 9 else (65_536,)
        jobs = [("gradient", n, True) for n in small] + [("rollout", n, True) for n in many]
        if "kernel rolled block256" in engine:
            jobs.append(("rollout", 65_536, False))
        if order == "first":
            jobs = [("rollout", 65_536, True), ("gradient", 16_384, True)]
        for what, size, closed in jobs:
            q, v, _, ctrl = batch(m, size, last=True)
            if what == "rollout":
                ctrls, f = jnp.tile(ctrl[None, :, 0], (STEPS, 1)), run
            else:
                ctrls = jnp.tile(ctrl[None], (STEPS, 1, 1))
                ctrls = jnp.transpose(ctrls, (2, 0, 1)) if order == "first" else ctrls
                f = gradient(run)
            row = {"what": what, "robot": name, "engine": engine, "batch": size}
            if closed:
                row = timed(row, lambda *x, f=f: f(model, *x), q, v, ctrls, work=size * STEPS)
            else:
                row["engine"] += " traced"
                row = timed(row, f, model, q, v, ctrls, work=size * STEPS)
            rows.append(row)
    # errors of the kernels against the scan in f32, on a few samples
    q, v, _, ctrl = batch(m, 256, last=True)
    each = jnp.tile(ctrl[None], (STEPS, 1, 1))
    want = gradient(lambda *x: by_scan(*x, "rolled"))(model, q, v, jnp.transpose(each, (2, 0, 1)))
    want = jnp.transpose(want, (1, 2, 0))
    for plan in plans(model, False):
        by_plan = gradient(lambda *y, p=plan: by_kernel(*y, p))
        got = jax.jit(lambda *x, f=by_plan: f(model, *x))(q, v, each)
        error = abs(got - want).max((0, 1)) / abs(want).max((0, 1))
        note = f"median {jnp.median(error):.1e} max {error.max():.1e} (f32 kernel - f32 scan)"
        rows.append({"what": "gradient error", "robot": name, "engine": plan.driver, "note": note})
        print(rows[-1], flush=True)
    return rows


if __name__ == "__main__":
    opts = options(__doc__)
    for robot in opts.robots:
        finish(f"gpu-rollout-{robot}", bench(robot, opts.batches, bool(opts.tag)))
