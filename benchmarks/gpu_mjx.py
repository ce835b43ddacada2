"""MJX on an accelerator: forward dynamics, steps in a rollout, gradients of a rollout, f32 error.

`python -m benchmarks.gpu_mjx --robots panda` writes results/gpu-mjx-<robot>-<device>.json.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from benchmarks.gpu_models import batch, pair, states
from benchmarks.gpu_timing import finish, options, timed

STEPS = 100


def relative(got: np.ndarray, want: np.ndarray) -> np.ndarray:
    """Per state the largest deviation over the largest entry."""
    return np.abs(got - want).max(-1) / np.abs(want).max(-1)


def exact(m: mujoco.MjModel, count: int = 256) -> tuple[tuple, np.ndarray]:
    """Random states and MuJoCo's accelerations in f64 under applied torques."""
    q, v, tau, ctrl = states(m, count, seed=1)
    data, out = mujoco.MjData(m), []
    for i in range(count):
        data.qpos, data.qvel, data.qfrc_applied = q[i], v[i], tau[i]
        data.ctrl = 0
        mujoco.mj_forward(m, data)
        passive = data.qfrc_passive + data.qfrc_actuator
        data.qfrc_applied = tau[i] - passive  # so that tau is all that is applied
        mujoco.mj_forward(m, data)
        out.append(data.qacc.copy())
    return (q, v, tau, ctrl), np.array(out)


def bench(name: str, batches) -> list[dict]:
    m, _ = pair(name)
    model, blank = mjx.put_model(m), mjx.make_data(m)
    rows: list[dict] = []

    def put(q, v, ctrl, tau):
        return blank.replace(qpos=q, qvel=v, ctrl=ctrl, qfrc_applied=tau)

    def forward(q, v, ctrl, tau):
        return mjx.forward(model, put(q, v, ctrl, tau)).qacc

    (q, v, tau, ctrl), want = exact(m)
    passive = []
    data = mujoco.MjData(m)
    for i in range(len(q)):
        data.qpos, data.qvel, data.ctrl = q[i], v[i], 0
        mujoco.mj_forward(m, data)
        passive.append(data.qfrc_passive + data.qfrc_actuator)
    applied = (tau - np.array(passive)).astype(np.float32)
    got = jax.jit(jax.vmap(forward))(q, v, 0 * ctrl, applied)
    error = relative(np.asarray(got, np.float64), want)
    rows.append({"what": "f32 error", "robot": name, "engine": "mjx",
                 "note": f"median {np.median(error):.2e} max {error.max():.2e}"})  # fmt: skip
    print(rows[-1], flush=True)
    for size in batches or (4096, 16384, 65536, 262144):
        q, v, tau, ctrl = batch(m, size, last=False)
        row = {"what": "forward", "robot": name, "engine": "mjx", "batch": size}
        rows.append(timed(row, jax.vmap(forward), q, v, ctrl, tau, work=size))

    def step(q, v, ctrl):
        d = mjx.step(model, blank.replace(qpos=q, qvel=v, ctrl=ctrl))
        return d.qpos, d.qvel

    def rollout(q, v, ctrls):
        f = jax.vmap(step, (0, 0, None))
        return jax.lax.scan(lambda c, u: (f(*c, u), None), (q, v), ctrls)[0]

    def gradient(q, v, ctrls):
        def loss(ctrls):
            f = jax.checkpoint(jax.vmap(step))
            (q1, v1), _ = jax.lax.scan(lambda c, u: (f(*c, u), None), (q, v), ctrls)
            return (q1 * q1).sum() + (v1 * v1).sum()

        return jax.grad(loss)(ctrls)

    for size in (16384, 65536):
        q, v, _, ctrl = batch(m, size, last=False)
        ctrls = jnp.asarray(np.tile(np.asarray(ctrl[:1]), (STEPS, 1)))
        row = {"what": "rollout", "robot": name, "engine": "mjx", "batch": size}
        rows.append(timed(row, rollout, q, v, ctrls, work=size * STEPS))
    for size in (4096, 16384, 65536):
        q, v, _, ctrl = batch(m, size, last=False)
        ctrls = jnp.tile(ctrl[None], (STEPS, 1, 1))
        row = {"what": "gradient", "robot": name, "engine": "mjx", "batch": size}
        rows.append(timed(row, gradient, q, v, ctrls, work=size * STEPS))
        if "note" in rows[-1]:
            break
    return rows


if __name__ == "__main__":
    opts = options(__doc__)
    for robot in opts.robots:
        finish(f"gpu-mjx-{robot}", bench(robot, opts.batches))
