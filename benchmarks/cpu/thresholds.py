"""Measurements behind two thresholds under XLA on the CPU: when to roll, and the width of a chunk.

`python -m benchmarks.cpu.thresholds`, about three minutes: one core, f64. For serial chains of
hinges, forward dynamics with both drivers: seconds to compile it and its gradient, and nanoseconds
a sample in chunks of 240 (`drivers.UNROLLED_UP_TO`). For the Panda and G1, nanoseconds by the width
of a chunk.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import time
import warnings

import jax
import mujoco

import rbjax as rb
from benchmarks.shared.robots import compiled, ours, states
from benchmarks.shared.timing import markdown_table, measure, save
from benchmarks.shared.under_xla import under_xla

BATCH = 1024
LENGTHS = (4, 6, 8, 10, 12, 16)
WIDTHS = (64, 128, 144, 208, 240, 256, 512, 1024)


def chain(n: int) -> mujoco.MjModel:
    """n hinges in series, their axes turning from link to link."""
    bodies = ""
    for k in reversed(range(n)):
        axis = ("1 0 0", "0 1 0", "0 0 1")[k % 3]
        bodies = (
            f'<body pos="0.05 0 -0.1"><joint axis="{axis}"/>'
            f'<geom type="capsule" size="0.02" fromto="0 0 0 0.05 0 -0.1"/>{bodies}</body>'
        )
    xml = f'<mujoco><option><flag contact="disable"/></option><worldbody>{bodies}</worldbody>'
    return mujoco.MjModel.from_xml_string(xml + "</mujoco>")


def chunked(model: rb.Model, width: int):
    """Forward dynamics of a batch, in chunks."""

    def run(*batch):
        one = lambda x: rb.forward_dynamics(model, *x)  # noqa: E731
        return jax.lax.map(one, batch, batch_size=width)

    return run


def compile_gradient_s(model: rb.Model, batch) -> float:
    def loss(*x):
        return jax.vmap(lambda *one: rb.forward_dynamics(model, *one))(*x).sum()

    start = time.perf_counter()
    jax.jit(jax.grad(loss, (0, 1, 2))).lower(*batch).compile()
    return time.perf_counter() - start


def by_length() -> list[dict]:
    rows = []
    for n in LENGTHS:
        m = chain(n)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            model = rb.load(m)
        batch = states(m, BATCH)
        for driver in ("unrolled", "rolled"):
            one = model.replace(driver=driver)
            timed = measure(chunked(one, 240), *batch, budget_s=0.3)
            rows.append(
                {
                    "robot": f"chain of {n}",
                    "driver": driver,
                    "chunk": 240,
                    "compile_s": timed["lower_s"] + timed["compile_s"],
                    "gradient_compile_s": compile_gradient_s(one, batch),
                    "ns": timed["run_min_s"] / BATCH * 1e9,
                }
            )
            print(rows[-1], flush=True)
    return rows


def by_width() -> list[dict]:
    rows = []
    for name in ("panda", "g1"):
        batch = states(compiled(name), BATCH)
        for width in WIDTHS:
            timed = measure(chunked(ours(name), width), *batch, budget_s=0.3)
            ns = timed["run_min_s"] / BATCH * 1e9
            rows.append({"robot": name, "driver": "auto", "chunk": width, "ns": ns})
            print(rows[-1], flush=True)
    return rows


def main() -> None:
    rows = by_length() + by_width()
    print(markdown_table(rows, rows[0]))
    print(save("cpu-thresholds", rows))


if __name__ == "__main__":
    with under_xla():
        main()
