"""One call of forward dynamics of beams on one core: `rb.compile` and jitted JAX, in f64.

python -m benchmarks.cpu.one_call_beams

The beams are those of `benchmarks.gpu.flexible`, of 8 and 52 coordinates.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import time
from typing import Any

import jax
import numpy as np

import rbjax as rb
from benchmarks.cases.beams import CASES
from benchmarks.cpu.one_call import CALLS, many
from benchmarks.shared.timing import fastest_ns, markdown_table, save

BEAMS = ("spatial 8, 5 points", "13 x 4")


def beam(name: str) -> dict[str, Any]:
    model = CASES[name]()
    q, v, tau = 0.3 * np.random.default_rng(0).normal(size=(3, model.nv))

    def f(q, v, tau):
        return rb.forward_dynamics(model, q, v, tau)

    start = time.perf_counter()
    native = rb.compile(f, q, v, tau)
    row: dict[str, Any] = {"robot": name, "nv": model.nv, "native": native.native}
    row["compile_s"] = time.perf_counter() - start
    jitted = jax.jit(f)
    start = time.perf_counter()
    want = np.asarray(jitted(q, v, tau))
    row["jit_compile_s"] = time.perf_counter() - start
    row["error_jit"] = float(np.abs(native(q, v, tau) - want).max() / np.abs(want).max())
    row["compiled_ns"] = fastest_ns(many(native, q, v, tau), CALLS)
    row["jit_ns"] = fastest_ns(many(lambda *x: jitted(*x).block_until_ready(), q, v, tau), CALLS)
    return row


def main() -> None:
    with jax.enable_x64(True):
        rows = [beam(name) for name in BEAMS]
    print(markdown_table(rows, rows[0]))
    print(save("cpu-one-call-beams", rows))


if __name__ == "__main__":
    main()
