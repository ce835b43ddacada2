"""Forward dynamics of a batch on one core: samples as lanes of vectors, sample by sample, and XLA.

python -m benchmarks.cpu.vectors
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import time
from typing import Any

import jax
import numpy as np

import rbjax as rb
from benchmarks.shared.progress import progress
from benchmarks.shared.robots import NAMES, as_model, compiled, states
from benchmarks.shared.timing import fastest_ns, markdown_table, save
from benchmarks.shared.under_xla import under_xla
from rbjax.compiler.ir.program import batch_first, batch_last
from rbjax.compiler.lower.write import write_program
from rbjax.compiler.llvm.batch import write_parts
from benchmarks.shared.part_function import part_function

BATCH = 1024
RUNS = 200  # short ones: the best of them had the core for itself
PLACES = {"batch first": batch_first, "batch last": batch_last}


def robot(name: str, dtype: type) -> list[dict[str, Any]]:
    reference = compiled(name)
    model = as_model(reference)
    args = [np.ascontiguousarray(x, dtype) for x in states(reference, BATCH)]

    def f(q, v, tau):
        return rb.forward_dynamics(model, q, v, tau)

    jitted = jax.jit(jax.vmap(f))
    start = time.process_time()
    with under_xla():
        want = np.asarray(jitted(*args))
    xla = {
        "compile_s": time.process_time() - start,
        "ns": fastest_ns(lambda: jitted(*args).block_until_ready(), BATCH, RUNS),
    }
    rows: list[dict[str, Any]] = [{"robot": name, "bits": want.itemsize * 8, "by": "XLA", **xla}]
    for place, layout in PLACES.items():
        start = time.process_time()
        closed = jax.make_jaxpr(f)(*(x[0] for x in args))
        ins = [layout(x.shape[1:], (BATCH,)) for x in args]
        (out,) = [layout(a.shape, (BATCH,)) for a in closed.out_avals]
        program = write_program(closed, (BATCH,), ins, [out])
        program_s = time.process_time() - start
        given = [np.ascontiguousarray(x if place == "batch first" else x.T) for x in args]
        for by, lanes in (("vectors", None), ("a sample at a time", 1)):
            start = time.process_time()
            run, _ = part_function(write_parts(program, lanes))
            result = np.empty(out.shape, dtype)
            run([*given, result])
            compile_s = time.process_time() - start
            got = result if place == "batch first" else result.T
            ns = fastest_ns(lambda run=run, y=result, xs=given: run([*xs, y]), BATCH, RUNS)
            rows.append({
                "robot": name, "bits": want.itemsize * 8, "by": f"{by}, {place}", "ns": ns,
                "over_xla": ns / xla["ns"], "program_s": program_s, "compile_s": compile_s,
                "difference": float(np.abs(got - want).max() / np.abs(want).max()),
            })  # fmt: skip
    return rows


def main() -> None:
    rows = [row for dtype in (np.float64, np.float32) for name in progress(NAMES)
            for row in robot(name, dtype)]  # fmt: skip
    print(markdown_table(rows, rows[1]))
    print(save("cpu-vectors", rows))


if __name__ == "__main__":
    main()
