"""Compile time of forward dynamics on the CPU, ours over MJX's: trace, lower and compile.

`python -m benchmarks.cpu.compile [ROBOT ...] [--full] [--limit SECONDS]`. By default the first
robot, --full all. f32, batch 1,024, default flags, the model is an argument in both; one result
file a robot. MJX takes minutes a robot, so each engine runs in its own process, which ends after
`--limit` seconds.
"""

from __future__ import annotations

import argparse
import multiprocessing
import time
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from mujoco import mjx

import rbjax as rb
from benchmarks.shared.progress import add_full, progress
from benchmarks.shared.robots import ALL, compiled, ours, states
from benchmarks.shared.timing import markdown_table, save

BATCH = 1024


def compile_seconds(engine: str, name: str) -> float:
    """Seconds to trace, lower and compile one engine's forward dynamics."""
    m = compiled(name)
    q, v, tau = (jnp.asarray(x, jnp.float32) for x in states(m, BATCH))
    if engine == "rbjax":
        f: Any = jax.vmap(rb.forward_dynamics, in_axes=(None, 0, 0, 0))
        args: tuple = (ours(name), q, v, tau)
    else:
        m.opt.solver = mujoco.mjtSolver.mjSOL_NEWTON
        m.opt.cone = mujoco.mjtCone.mjCONE_PYRAMIDAL

        def f(mx, data, q, v, tau):
            def one(q, v, tau):
                return mjx.forward(mx, data.replace(qpos=q, qvel=v, qfrc_applied=tau)).qacc

            return jax.vmap(one)(q, v, tau)

        args = (mjx.put_model(m), mjx.make_data(m), q, v, tau)
    start = time.perf_counter()
    jax.jit(f).lower(*args).compile()
    return time.perf_counter() - start


def _send(pipe: Any, engine: str, name: str) -> None:
    pipe.send(compile_seconds(engine, name))


def limited(engine: str, name: str, limit: float) -> float | None:
    """`compile_seconds` in its own process; None if it takes longer than the limit."""
    here, there = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_send, args=(there, engine, name))
    process.start()
    there.close()
    try:
        return here.recv() if here.poll(limit) else None
    finally:
        process.kill()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="if left out, those of the size")
    parser.add_argument("--limit", type=float, help="seconds; 1,800 with --full, else 120")
    add_full(parser, ", ".join(ALL), next(iter(ALL)))
    opts = parser.parse_args()
    limit = opts.limit or (1800.0 if opts.full else 120.0)
    rows = []
    for name in progress(opts.robots or [*ALL][: None if opts.full else 1]):
        row: dict[str, Any] = {"robot": name, "nv": compiled(name).nv}
        mine = limited("rbjax", name, limit)
        peer = limited("MJX", name, limit)
        row |= {"rbjax s": mine or f"> {limit:g}", "MJX s": peer or f"> {limit:g}"}
        if mine:
            ratio = mine / (peer or limit)
            row["ratio"] = ratio if peer else f"< {ratio:.2g}"
        rows.append(row)
        print(row, save(f"cpu-compile-{name}", [row]), flush=True)
    print(markdown_table(rows, ("robot", "nv", "rbjax s", "MJX s", "ratio")))


if __name__ == "__main__":
    main()
