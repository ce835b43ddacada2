"""`sincos` against XLA's own sine and cosine on one CPU core: `python -m benchmarks.cpu.sincos`.

Nanoseconds for a pair, with random angles of a few turns in an array that fits the cache and passes
a barrier, as in the algorithms; and the largest error against NumPy (in f32, against f64).
"""

from __future__ import annotations

import benchmarks.shared.one_core  # noqa: F401  isort: skip

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.timing import markdown_table, measure, save
from rbjax.lanes import fusion_barrier, sincos

COUNT = 16_384
WAYS = {"rbjax": sincos, "xla": lambda x: (jnp.cos(x), jnp.sin(x))}


def main() -> None:
    angles = np.random.default_rng(0).uniform(-20.0, 20.0, COUNT)
    rows = []
    for precision in ("float32", "float64"):
        x = jnp.asarray(angles, precision)
        exact = np.array([np.cos(np.asarray(x, float)), np.sin(np.asarray(x, float))])
        row: dict[str, object] = {"precision": precision}
        for name, pair in WAYS.items():
            run = jax.jit(
                lambda x, pair=pair: fusion_barrier(pair(x)), compiler_options=rb.compiler_options()
            )
            row[f"{name} ns"] = measure(run, x)["run_s"] / COUNT * 1e9
            row[f"{name} error"] = float(np.abs(np.asarray(run(x), float) - exact).max())
        rows.append(row | {"ratio": row["xla ns"] / row["rbjax ns"]})
    print(markdown_table(rows, rows[0]))
    print(save("cpu-sincos", rows))


if __name__ == "__main__":
    main()
