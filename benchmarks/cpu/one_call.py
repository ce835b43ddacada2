"""One call of forward dynamics: jitted JAX, `rb.compile` and MuJoCo C's `mj_forward`, in one run.

python -m benchmarks.cpu.one_call
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import time
from typing import Any

import jax
import mujoco
import numpy as np

import rbjax as rb
from benchmarks.shared.robots import NAMES, as_model, compiled, states
from benchmarks.shared.timing import fastest_ns, markdown_table, save

CALLS = 300


def many(f, *args) -> Any:
    def run() -> None:
        for _ in range(CALLS):
            f(*args)

    return run


def robot(name: str) -> dict[str, Any]:
    reference = compiled(name)
    model = as_model(reference)
    q, v, tau = (np.ascontiguousarray(x[0]) for x in states(reference, 1))

    def f(q, v, tau):
        return rb.forward_dynamics(model, q, v, tau)

    start = time.perf_counter()
    native = rb.compile(f, q, v, tau)
    compile_s = time.perf_counter() - start
    assert native.native
    jitted, empty = jax.jit(f), jax.jit(lambda q, v, tau: tau, keep_unused=True)
    start = time.perf_counter()
    want = jitted(q, v, tau).block_until_ready()
    jit_compile_s = time.perf_counter() - start
    row: dict[str, Any] = {"robot": name, "compile_s": compile_s, "jit_compile_s": jit_compile_s}

    data = mujoco.MjData(reference)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, tau
    mujoco.mj_forward(reference, data)
    data.qfrc_applied[:] -= data.qfrc_passive  # springs and dampers, which the other two lack
    mujoco.mj_forward(reference, data)
    got = native(q, v, tau)
    size = np.abs(data.qacc).max()
    row["error_mujoco"] = float(np.abs(got - data.qacc).max() / size)
    row["error_jit"] = float(np.abs(got - want).max() / size)

    same = rb.compile(lambda q, v, tau: tau, q, v, tau)
    row["compiled_ns"] = fastest_ns(many(native, q, v, tau), CALLS)
    row["compiled_empty_ns"] = fastest_ns(many(same, q, v, tau), CALLS)
    row["mujoco_ns"] = fastest_ns(many(mujoco.mj_forward, reference, data), CALLS)
    row["jit_ns"] = fastest_ns(many(lambda *x: jitted(*x).block_until_ready(), q, v, tau), CALLS)
    row["jit_empty_ns"] = fastest_ns(many(lambda *x: empty(*x).block_until_ready(), q, v, tau),
                                     CALLS)  # fmt: skip
    row["jit_over_empty"] = row["jit_ns"] / row["jit_empty_ns"]
    row["over_mujoco"] = row["compiled_ns"] / row["mujoco_ns"]
    return row


def main() -> None:
    rows = [robot(name) for name in NAMES]
    print(markdown_table(rows, rows[0]))
    print(save("cpu-one-call", rows))


if __name__ == "__main__":
    main()
