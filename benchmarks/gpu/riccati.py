"""The Riccati recursion, serial and parallel in time: where the two cross.

`python -m benchmarks.gpu.riccati --save` writes results/riccati-<device>.json. It runs on a CPU,
too. All programs are compiled first, several at a time.

n = 12 states and m = 6 controls, horizons of 16 to 4,096 steps, 1 and 64 problems. Serial: a thread
a problem (`rb.threads`), and a scan under XLA. Parallel: `backward(parallel=True)`, under XLA, by
doubling.
Each result is compared with that of the thread; `difference` is the largest of K, k, P and p,
relative to the largest entry of each. Times are the least of several, in ms a batch.
"""

from __future__ import annotations

import argparse
import concurrent.futures
import functools
import itertools
import json
import os
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.timing import markdown_table, save
from rbjax.control.linear import LinearQuadratic, backward
from rbjax.control.linear.riccati import Gains

COLUMNS = ("precision", "batch", "horizon", "method", "compile_s", "ms", "us a step", "difference")
HORIZONS = (16, 64, 256, 1024, 4096)
DTYPES = {"f32": jnp.float32, "f64": jnp.float64}
N_STATES, N_CONTROLS = 12, 6


def problems(batch: int, horizon: int, dtype: Any) -> LinearQuadratic:
    """Convex ones with gaps, slopes and products of states and controls."""
    rng, n, m = np.random.default_rng(horizon), N_STATES, N_CONTROLS
    lead = (batch, horizon)
    W = rng.normal(size=(batch, horizon + 1, n + m, n + m)) / np.sqrt(n + m)
    W = W @ W.swapaxes(-1, -2) + 0.1 * np.eye(n + m)
    A, B = rng.normal(size=(*lead, n, n)) / np.sqrt(n), rng.normal(size=(*lead, n, m))
    d, r = rng.normal(size=(*lead, n)), rng.normal(size=(*lead, m))
    q = rng.normal(size=(batch, horizon + 1, n))
    each = (A, B, d, W[..., :n, :n], q, W[:, :-1, n:, n:], r, W[:, :-1, :n, n:])
    return LinearQuadratic(*(jnp.asarray(x, dtype) for x in each))


METHODS: dict[str, Callable] = {
    "serial, thread": jax.jit(jax.vmap(rb.threads(backward))),
    "serial, XLA": jax.jit(jax.vmap(backward)),
    "parallel, doubling": jax.jit(jax.vmap(functools.partial(backward, parallel=True))),
}


def difference(one: Gains, other: Gains) -> float:
    def largest(x: Any, y: Any) -> float:
        x, y = np.asarray(x, float), np.asarray(y, float)
        return float(np.abs(x - y).max() / np.abs(y).max())

    return max(largest(x, y) for x, y in zip(one[:4], other[:4], strict=True))


def compiled(case: tuple[str, int, int, str]) -> tuple[float, Callable]:
    """Seconds to compile, beside others, and the program."""
    precision, batch, horizon, name = case
    z = jax.eval_shape(lambda: problems(batch, horizon, DTYPES[precision]))
    start = time.perf_counter()
    program = METHODS[name].lower(z).compile()
    return time.perf_counter() - start, program


def least(program: Callable, z: LinearQuadratic, seconds: float) -> tuple[float, Gains]:
    """The least time of a call in s, and its result."""
    out = jax.block_until_ready(program(z))
    best, end = np.inf, time.perf_counter() + seconds
    for turn in range(100):
        start = time.perf_counter()
        jax.block_until_ready(program(z))
        best = min(best, time.perf_counter() - start)
        if turn >= 2 and time.perf_counter() > end:
            break
    return best, out


def run(
    horizons: tuple[int, ...],
    batches: list[int],
    precisions: list[str],
    methods: list[str],
    seconds: float,
) -> list[dict[str, Any]]:
    cases = list(itertools.product(precisions, batches, horizons, methods))
    with concurrent.futures.ThreadPoolExecutor(min(8, os.cpu_count() or 1)) as pool:
        programs = list(pool.map(compiled, cases))
    rows, want = [], None
    for case, (compiling, program) in zip(cases, programs, strict=True):
        precision, batch, horizon, name = case
        best, out = least(program, problems(batch, horizon, DTYPES[precision]), seconds)
        want = out if name == methods[0] else want
        row = {
            "precision": precision, "batch": batch, "horizon": horizon, "method": name,
            "compile_s": compiling, "ms": 1e3 * best, "us a step": 1e6 * best / horizon / batch,
            "difference": difference(out, want), "ok": bool(jnp.all(out.success)),
        }  # fmt: skip
        rows.append(row)
        print(json.dumps(row), flush=True)
    return rows


def crossings(rows: list[dict[str, Any]]) -> list[str]:
    """For each precision and batch the first horizon from which parallel is faster for good."""
    said = []
    for precision, batch in dict.fromkeys((r["precision"], r["batch"]) for r in rows):
        mine = [r for r in rows if (r["precision"], r["batch"]) == (precision, batch)]
        serial: dict[int, float] = {}
        parallel: dict[int, float] = {}
        for r in mine:
            into = parallel if r["method"].startswith("parallel") else serial
            into[r["horizon"]] = min(r["ms"], into.get(r["horizon"], np.inf))
        faster = [h for h in serial if all(parallel[k] < serial[k] for k in serial if k >= h)]
        where = f"from {min(faster)} steps on" if faster else "nowhere"
        said.append(f"{precision}, batch {batch}: parallel is faster {where}")
    return said


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--horizons", type=int, nargs="+", default=HORIZONS)
    parser.add_argument("--batches", type=int, nargs="+", default=(1, 64))
    parser.add_argument("--precision", nargs="+", default=["f32", "f64"])
    parser.add_argument("--seconds", type=float, default=0.5, help="of timing for each row")
    parser.add_argument("--save", action="store_true")
    given = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    horizons, batches = tuple(given.horizons), list(given.batches)
    rows = run(horizons, batches, given.precision, list(METHODS), given.seconds)
    print(markdown_table(rows, COLUMNS))
    said = crossings(rows)
    print("\n".join(said))
    if given.save:
        save("riccati", [*rows, *({"crossing": x} for x in said)])


if __name__ == "__main__":
    main()
