"""Algorithms of a batch of 1,024 on one core: machine code beside XLA, in one process by turns.

    python -m benchmarks.cpu.back_ends [--full] [ROBOT ...]

--full: all three robots, by default the first. Both run `jax.jit(jax.vmap(f))` with the model
closed over and default options, batch first.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import argparse
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.shared.progress import add_full, progress
from benchmarks.shared.robots import NAMES, as_model, compiled, states
from benchmarks.shared.timed_algorithms import ALGORITHMS
from benchmarks.shared.timing import markdown_table, others, save
from benchmarks.shared.under_xla import under_xla

BATCH = 1024
#: at least so many turns, for so many seconds: the best of them had the core for itself
TURNS, SECONDS = 10, 4.0
COLUMNS = ("robot", "algorithm", "bits", "llvm_ns", "xla_ns", "speedup", "llvm_compile_s",
           "xla_compile_s", "difference")  # fmt: skip


def first(f: Callable, *args: Any) -> tuple[Callable, Any, float]:
    """f jitted for a batch, its results, and the CPU seconds until they are there."""
    jitted = jax.jit(jax.vmap(f))
    start = time.process_time()
    out = jax.block_until_ready(jitted(*args))
    return jitted, out, time.process_time() - start


def by_turns(fs: list[Callable], *args: Any) -> list[float]:
    """The best nanoseconds a sample of each."""
    best = [np.inf] * len(fs)
    end, turns = time.perf_counter() + SECONDS, 0
    while turns < TURNS or time.perf_counter() < end:
        for k, f in enumerate(fs):
            start = time.perf_counter()
            jax.block_until_ready(f(*args))
            best[k] = min(best[k], (time.perf_counter() - start) / BATCH * 1e9)
        turns += 1
    return best


def relative(got: Any, want: Any) -> float:
    """The largest difference of a result over its largest entry."""
    pairs = zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True)
    return max(float(jnp.abs(a - b).max() / jnp.abs(b).max()) for a, b in pairs)


def rows_of(name: str, dtype: type) -> list[dict[str, Any]]:
    reference = compiled(name)
    model = as_model(reference).astype(dtype)
    args = [jnp.asarray(np.ascontiguousarray(x), dtype) for x in states(reference, BATCH)]
    rows = []
    for algorithm in progress(ALGORITHMS, lambda x: f"{name} {dtype.__name__} {x}"):
        f = ALGORITHMS[algorithm]

        def one(*x: Any, f: Callable = f) -> Any:
            return f(model, *x)

        llvm, got, llvm_s = first(one, *args)
        with under_xla():
            xla, want, xla_s = first(lambda *x, one=one: one(*x), *args)
        llvm_ns, xla_ns = by_turns([llvm, xla], *args)
        row = {
            "robot": name, "algorithm": algorithm, "bits": np.dtype(dtype).itemsize * 8,
            "llvm_ns": llvm_ns, "xla_ns": xla_ns, "speedup": xla_ns / llvm_ns,
            "llvm_compile_s": llvm_s, "xla_compile_s": xla_s, "difference": relative(got, want),
        }  # fmt: skip
        print(markdown_table([row], COLUMNS).splitlines()[-1], flush=True)
        rows.append(row)
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("robots", nargs="*", help="if left out, those of the size")
    add_full(parser, ", ".join(NAMES), next(iter(NAMES)))
    asked = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for name in asked.robots or [*NAMES][: None if asked.full else 1]:
        for dtype in (np.float64, np.float32):
            rows += rows_of(name, dtype)
            kept = others("cpu-back-ends", rows, ("robot", "algorithm", "bits"))
            path = save("cpu-back-ends", [*kept, *rows])
    print(markdown_table(rows, COLUMNS))
    print(path)


if __name__ == "__main__":
    main()
