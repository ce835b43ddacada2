"""Rollouts of 100 steps on an accelerator, and their gradients by each sample's controls.

Final states only; semi-implicit Euler, f32. `python -m benchmarks.gpu_rollout --robots panda`
writes results/gpu-rollout-<robot>-<device>.json. The gradient's error is against central
differences of the rollout in f64 on the same device, of 20 steps, along random directions.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.gpu_mjx import STEPS
from benchmarks.gpu_timing import finish, options, timed
from benchmarks.robots import actuated, as_model, batch

MILLION = 1_048_576


def final(model, q, v, ctrls, kernel):
    """The last state, batch last."""
    steps = ctrls.shape[-2]
    out = rb.rollout(model, rb.State(q.T, v.T), ctrls, save_every=steps, kernel=kernel)
    return out.q[:, -1].T, out.v[:, -1].T


def gradient(model, q, v, ctrls, kernel):
    def loss(ctrls):
        q1, v1 = final(model, q, v, ctrls, kernel)
        return (q1 * q1).sum() + (v1 * v1).sum()

    return jax.grad(loss)(ctrls)


def bench(name: str, tuning: bool) -> list[dict]:
    m = actuated(name)
    model = as_model(m)
    small = model.nv <= 9
    most = MILLION if small else 262_144
    unrolled = model.replace(driver="unrolled")
    jobs = [
        ("rollout", "kernel", None, model, (65_536, most)),
        ("gradient", "kernel", None, model, (16_384, 65_536, *((262_144,) if small else ()))),
        ("rollout", "scan", False, model, (65_536,)),
        ("gradient", "scan", False, model, (16_384,)),
    ]
    if small:
        jobs.append(("gradient", "kernel, all unrolled", None, unrolled, (65_536, 262_144)))
    rows = [errors(name, m, model)]
    for what, engine, kernel, model, sizes in jobs:
        for size in sizes:
            q, v, _, ctrl = batch(m, size, last=True)
            if what == "rollout":
                ctrls, f = jnp.tile(ctrl[None, :, 0], (STEPS, 1)), final
            else:
                ctrls, f = jnp.tile(ctrl.T[:, None], (1, STEPS, 1)), gradient
            row = {"what": what, "robot": name, "engine": engine, "batch": size}
            rows.append(timed(row, lambda *x, f=f, m=model, k=kernel: f(m, *x, k),
                              q, v, ctrls, work=size * STEPS))  # fmt: skip
    return rows


def errors(name: str, m, model, count: int = 256, steps: int = 20) -> dict:
    """The kernel's gradient in f32 against central differences in f64."""
    q, v, _, ctrl = batch(m, count, last=True)
    ctrls = jnp.tile(ctrl.T[:, None], (1, steps, 1))
    got = jax.jit(lambda *x: gradient(model, *x, None))(q, v, ctrls)
    rng = np.random.default_rng(0)
    found, wanted = [], []
    with jax.enable_x64(True):
        q, v, u, got = (jnp.asarray(np.asarray(x, np.float64)) for x in (q, v, ctrls, got))

        @jax.jit
        def each(u):
            q1, v1 = final(model, q, v, u, False)
            return (q1 * q1).sum(0) + (v1 * v1).sum(0)

        for _ in range(4):
            way = rng.normal(size=u.shape)
            way /= np.linalg.norm(way, axis=(1, 2), keepdims=True)
            wanted.append(np.asarray(each(u + 1e-5 * way) - each(u - 1e-5 * way)) / 2e-5)
            found.append(np.asarray((got * way).sum((1, 2))))
        size = np.asarray(jnp.sqrt((got * got).mean((1, 2))))  # of a typical derivative
    error = np.abs(np.array(found) - np.array(wanted)) / size
    row = {"what": "gradient error", "robot": name, "engine": "kernel",
           "error median": float(np.median(error)), "error max": float(error.max()),
           "note": "f32 against central differences in f64, over their typical size"}  # fmt: skip
    print(row, flush=True)
    return row


if __name__ == "__main__":
    opts = options(__doc__)
    for robot in opts.robots:
        finish(f"gpu-rollout-{robot}", bench(robot, bool(opts.tag)))
