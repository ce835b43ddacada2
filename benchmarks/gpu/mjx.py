"""MJX (and frax) on an accelerator: forward dynamics, steps in a rollout, gradients of a rollout.

`python -m benchmarks.gpu.mjx --robots panda` writes results/gpu-mjx-<robot>-<device>.json.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from benchmarks.shared.gpu_timing import finish, options, timed
from benchmarks.shared.robots import actuated, batch, exact, relative

STEPS = 100
#: batch sizes around the fastest one of each figure
FORWARD, ROLLOUT, GRADIENT = (4096, 16384, 65536, 262144), (16384, 65536), (4096, 16384, 65536)


def bench(name: str, batches) -> list[dict]:
    m = actuated(name)
    model, blank = mjx.put_model(m), mjx.make_data(m)
    rows: list[dict] = []

    def put(q, v, ctrl, tau):
        return blank.replace(qpos=q, qvel=v, ctrl=ctrl, qfrc_applied=tau)

    def forward(q, v, ctrl, tau):
        return mjx.forward(model, put(q, v, ctrl, tau)).qacc

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

    (q, v, _, applied), want = exact(m, 256)
    got = jax.jit(jax.vmap(forward))(q, v, np.zeros((256, m.nu), np.float32), applied)
    error = relative(got, want)
    rows.append({"what": "f32 error", "robot": name, "engine": "mjx",
                 "error median": float(np.median(error)), "error max": error.max()})  # fmt: skip
    for size in batches or FORWARD:
        q, v, tau, ctrl = batch(m, size, last=False)
        row = {"what": "forward", "robot": name, "engine": "mjx", "batch": size}
        rows.append(timed(row, jax.vmap(forward), q, v, ctrl, tau, work=size))
    rows += frax_rows(name, batches or FORWARD[1:])
    for size in ROLLOUT:
        q, v, _, ctrl = batch(m, size, last=False)
        ctrls = jnp.asarray(np.tile(np.asarray(ctrl[:1]), (STEPS, 1)))
        row = {"what": "rollout", "robot": name, "engine": "mjx", "batch": size}
        rows.append(timed(row, rollout, q, v, ctrls, work=size * STEPS))
    for size in GRADIENT:
        q, v, _, ctrl = batch(m, size, last=False)
        ctrls = jnp.tile(ctrl[None], (STEPS, 1, 1))
        row = {"what": "gradient", "robot": name, "engine": "mjx", "batch": size}
        rows.append(timed(row, gradient, q, v, ctrls, work=size * STEPS))
        if "note" in rows[-1]:
            break
    return rows


def frax_rows(name: str, batches) -> list[dict]:
    """Forward dynamics of frax, for the robots that it ships."""
    if name not in ("panda", "g1"):
        return []
    try:
        import frax

        robot = frax.load_panda() if name == "panda" else frax.load_g1()
    except Exception as error:  # go on without an engine that does not load
        return [{"what": "forward", "robot": name, "engine": "frax", "note": repr(error)[:150]}]
    rows = []
    for size in batches:
        rng = np.random.default_rng(0)
        q = rng.uniform(-1, 1, (size, robot.nq)).astype(np.float32)
        if robot.is_quaternion_base:
            q[:, 3:7] /= np.linalg.norm(q[:, 3:7], axis=1, keepdims=True)
        v, tau = rng.normal(size=(2, size, robot.nv)).astype(np.float32)
        f = jax.vmap(lambda q, v, tau: robot.forward_dynamics(q, v, tau, None))
        row = {"what": "forward", "robot": name, "engine": "frax", "batch": size}
        rows.append(timed(row, f, *(jnp.asarray(x) for x in (q, v, tau)), work=size))
    return rows


if __name__ == "__main__":
    opts = options(__doc__)
    for robot in opts.robots:
        finish(f"gpu-mjx-{robot}", bench(robot, opts.batches))
