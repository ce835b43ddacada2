"""Robots on the floor on one core: a step of `rollout` with contacts, beside MuJoCo's `mj_step`.

    python -m benchmarks.cpu.contact [humanoid humanoid_feet FILE.xml ...]

Both start at the same state and take the same controls. MuJoCo runs with its default tolerance.
"batch_us" is the time for a robot of 64, each with its own state and controls.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import sys
import time
import warnings
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.cases.standing import on_floor, random_controls, settled
from benchmarks.shared.timing import fastest_ns, markdown_table, save

STEPS, BATCH = 200, 64


def row_of(name: str) -> dict[str, Any]:
    m = on_floor(name)
    q, v = (x[0] for x in settled(m, 1))
    ctrl = random_controls(m, np.random.default_rng(1), 1)[0]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        models = {"contact": rb.load(m), "free": rb.load(m, contacts=False)}
    row: dict[str, Any] = {"robot": Path(name).stem}
    for kind, model in models.items():

        def end(state: rb.State, u: Any, model: Any = model) -> Any:
            u = jnp.broadcast_to(u, (STEPS, model.nu)) if model.nu else None
            path = rb.rollout(model, state, u, m.opt.timestep, steps=STEPS, save_every=STEPS)
            return path.q[-1]

        state, u = rb.State(jnp.asarray(q), jnp.asarray(v)), jnp.asarray(ctrl)
        run, start = jax.jit(end), time.perf_counter()
        jax.block_until_ready(run(state, u))
        row[f"{kind}_compile_s"] = time.perf_counter() - start
        ns = fastest_ns(lambda run=run, x=(state, u): jax.block_until_ready(run(*x)), STEPS, 9)
        row[f"{kind}_us"] = ns / 1e3
    many = [*settled(m, BATCH), random_controls(m, np.random.default_rng(1), BATCH)]

    def ends(q: Any, v: Any, u: Any) -> Any:
        u = jnp.broadcast_to(u[:, None], (BATCH, STEPS, m.nu)) if m.nu else None
        return rb.rollout(
            models["contact"], rb.State(q, v), u, m.opt.timestep, steps=STEPS, save_every=STEPS
        ).q

    run = jax.jit(ends)
    ns = fastest_ns(lambda: jax.block_until_ready(run(*many)), STEPS * BATCH, 9)
    row["batch_us"] = ns / 1e3
    data = mujoco.MjData(m)

    def steps() -> None:
        mujoco.mj_resetData(m, data)
        data.qpos[:], data.qvel[:], data.ctrl[:] = q, v, ctrl
        for _ in range(STEPS):
            mujoco.mj_step(m, data)

    row["mj_step_us"] = fastest_ns(steps, STEPS, 9) / 1e3
    row["contacts at the end"] = data.ncon
    return row | {"over_mujoco": row["contact_us"] / row["mj_step_us"]}


if __name__ == "__main__":
    rows = [row_of(name) for name in sys.argv[1:] or ("humanoid", "humanoid_feet")]
    print(markdown_table(rows, tuple(rows[0])))
    save("cpu-contact", rows)
