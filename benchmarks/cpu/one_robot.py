"""One robot on one core: a step of `rollout`, `simulate`, gradients; by machine code and under XLA.

    python -m benchmarks.cpu.one_robot

Each back end is a process of its own (`RBJAX_CPU`). MuJoCo's `mj_step` is timed in both.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.shared.robots import NAMES, as_model, compiled, states
from benchmarks.shared.timing import fastest_ns, markdown_table, save
from rbjax.compiler.jax import launch

STEPS, BATCH = 200, 1024
COLUMNS = ("what", "robot", "llvm_us", "xla_us", "speedup", "mujoco_us", "over_mujoco",
           "llvm_compile_s", "xla_compile_s")  # fmt: skip


def timed(f: Callable, *args: Any, of: int = 1, runs: int = 15) -> dict[str, float]:
    """Microseconds of one of `of` evaluations in a call of jitted f; seconds until the first."""
    jitted = jax.jit(f)
    start = time.perf_counter()
    jax.block_until_ready(jitted(*args))
    compile_s = time.perf_counter() - start
    ns = fastest_ns(lambda: jax.block_until_ready(jitted(*args)), of, runs)
    return {"us": ns / 1e3, "compile_s": compile_s}


def mj_step_us(reference: mujoco.MjModel, q: np.ndarray) -> float:
    data = mujoco.MjData(reference)

    def steps() -> None:
        data.qpos[:], data.qvel[:] = q, 0.0
        for _ in range(STEPS):
            mujoco.mj_step(reference, data)

    return fastest_ns(steps, STEPS) / 1e3


def rows() -> list[dict[str, Any]]:
    """All by one back end."""
    jax.config.update("jax_enable_x64", True)
    out = []
    for name in NAMES:
        reference = compiled(name)
        model = as_model(reference)
        every = [jnp.asarray(np.ascontiguousarray(x)) for x in states(reference, BATCH)]
        q, v, _ = (x[0] for x in every)
        u = jnp.zeros((STEPS, model.nu))

        def dynamics(q: Any, v: Any, tau: Any, model: Any = model) -> Any:
            return rb.forward_dynamics(model, q, v, tau)

        def end(state: rb.State, u: Any, model: Any = model) -> Any:
            return rb.rollout(model, state, u, 0.001, save_every=STEPS).q[-1]

        row = {"what": "forward dynamics, batch first, a sample", "robot": name}
        out.append(row | timed(jax.vmap(dynamics), *every, of=BATCH))
        row = {"what": "rollout, a step", "robot": name, "mujoco_us": mj_step_us(reference, q)}
        out.append(row | timed(end, rb.State(q, v), u, of=STEPS))
    arm = rb.load("arm7")
    start, u = arm.random_state(jax.random.key(0)), jnp.zeros((100, arm.nu))

    def loss(model: rb.Model, state: rb.State, u: Any) -> Any:
        return (rb.rollout(model, state, u, 0.001, save_every=100).q[-1] ** 2).sum()

    for what, which in (("model", 0), ("controls", 2)):
        row = {"what": f"gradient of 100 steps by the {what}", "robot": "arm7"}
        out.append(row | timed(jax.grad(loss, which), arm, start, u, runs=5))
    humanoid = rb.load("humanoid")
    start, ts = humanoid.random_state(jax.random.key(0)), jnp.array([0.0, 1.0])
    row = {"what": "simulate, 1 s, tolerance 1e-8", "robot": "humanoid"}
    out.append(row | timed(lambda s: rb.simulate(humanoid, s, ts).q[-1], start, runs=5))
    return out


def main() -> None:
    if sys.argv[1:] == ["--rows"]:
        print(json.dumps(rows()))
        return
    found = {}
    for name in launch.CHOICES:
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.cpu.one_robot", "--rows"], check=True, text=True,
            env=os.environ | {launch.VARIABLE: name}, stdout=subprocess.PIPE,
        )  # fmt: skip
        found[name] = json.loads(done.stdout.splitlines()[-1])
    table = []
    for llvm, xla in zip(found["llvm"], found["xla"], strict=True):
        row = {"what": llvm["what"], "robot": llvm["robot"]}
        for name, one in (("llvm", llvm), ("xla", xla)):
            row |= {f"{name}_us": one["us"], f"{name}_compile_s": one["compile_s"]}
        row["speedup"] = row["xla_us"] / row["llvm_us"]
        if "mujoco_us" in llvm:
            row["mujoco_us"] = min(llvm["mujoco_us"], xla["mujoco_us"])
            row["over_mujoco"] = row["llvm_us"] / row["mujoco_us"]
        table.append(row)
    print(markdown_table(table, COLUMNS))
    print(save("cpu-one-robot", table))


if __name__ == "__main__":
    main()
