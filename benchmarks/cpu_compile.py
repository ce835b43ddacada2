"""Compile time of forward dynamics on the CPU, ours over MJX's: trace, lower and compile.

`python -m benchmarks.cpu_compile [ROBOT ...]`. f32, batch 1,024, default flags, model an argument
in both. (MJX takes minutes a robot.)
"""

from __future__ import annotations

import sys
import time

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

import rbjax as rb
from benchmarks.robots import NAMES, compiled, ours, states
from benchmarks.timing import markdown_table, save

BATCH = 1024


def compile_seconds(f, *args) -> float:
    start = time.perf_counter()
    jax.jit(f).lower(*args).compile()
    return time.perf_counter() - start


def main() -> None:
    rows = []
    for name in sys.argv[1:] or (*NAMES, "tree60"):
        m = compiled(name)
        m.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        m.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL
        q, v, tau = (jnp.asarray(x, jnp.float32) for x in states(m, BATCH))
        model = ours(name)
        fd = jax.vmap(rb.forward_dynamics, in_axes=(None, 0, 0, 0))
        mine = compile_seconds(fd, model, q, v, tau)
        mx = mjx.put_model(m)
        data = mjx.make_data(m)

        def theirs(mx, data, q, v, tau):
            def one(q, v, tau):
                return mjx.forward(mx, data.replace(qpos=q, qvel=v, qfrc_applied=tau)).qacc

            return jax.vmap(one)(q, v, tau)

        peer = compile_seconds(theirs, mx, data, q, v, tau)
        rows.append(
            {"robot": name, "nv": m.nv, "rbjax s": mine, "MJX s": peer, "ratio": mine / peer}
        )
        print(rows[-1], save("cpu-compile", rows), flush=True)  # MJX's take minutes: keep each
    print(markdown_table(rows, rows[-1]))


if __name__ == "__main__":
    main()
