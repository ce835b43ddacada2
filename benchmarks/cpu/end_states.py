"""End states as constraints: an acrobot from rest at the bottom to rest at the top.

`python -m benchmarks.cpu.end_states [--methods a,b] [--guesses 10]` writes
results/cpu-end-states-<processor>.json. The first guess of the controls is zero, the others are
random. At most 1,000 iterations, in f64 and f32. A search counts as converged by its status, with
a violation of at most 1e-6 (f32: 10 units in the last place of 1). The violation is the median and
the largest of all searches, in rad and rad/s.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.progress import progress
from benchmarks.shared.timing import markdown_table, save
from rbjax.control import Constraint, Control, Problem, StateError, Status, solve

COLUMNS = (
    "precision", "method", "guesses", "converged", "others", "violation", "largest violation",
    "iterations", "lowest cost", "seconds",
)  # fmt: skip
METHODS = "ddp,sqp,exact_ddp,exact_sqp"
KNOTS, ITERATIONS = 100, 1000


def row(method: str, count: int) -> dict[str, Any]:
    model = rb.load("acrobot")
    upright = Constraint(StateError(model.keyframe("up")), where="end", name="upright")
    problem = Problem(
        model, KNOTS, 0.05, running=[Control()], constraints=[upright], bounds=(-20, 20)
    )
    random = [2 * np.random.default_rng(k).normal(size=(KNOTS, 1)) for k in range(1, count)]
    guesses = jnp.asarray(np.stack([np.zeros((KNOTS, 1)), *random]), model.gravity.dtype)

    def one(ctrl: jax.Array) -> tuple:
        s = solve(problem, model.keyframe("down"), method=method, ctrl=ctrl, iterations=ITERATIONS)
        return s.status, s.iterations, s.cost, s.violation

    begin = time.perf_counter()
    found = jax.block_until_ready(jax.jit(jax.vmap(one))(guesses))
    status, iterations, cost, off = (np.asarray(x) for x in found)
    good = status == Status.CONVERGED
    others = {Status(k).name: int((status == k).sum()) for k in np.unique(status[~good])}
    return {
        "precision": f"f{8 * model.gravity.dtype.itemsize}", "method": method, "guesses": count,
        "converged": int(good.sum()), "others": others, "violation": float(np.median(off)),
        "largest violation": float(off.max()), "iterations": int(np.median(iterations)),
        "lowest cost": float(cost[good].min()) if good.any() else None,
        "seconds": time.perf_counter() - begin,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--methods", default=METHODS)
    parser.add_argument("--guesses", type=int, default=10)
    asked = parser.parse_args()
    rows = []
    for wide in (True, False):
        for method in progress(asked.methods.split(",")):
            with jax.enable_x64(wide):
                rows.append(row(method, asked.guesses))
            print(rows[-1], flush=True)
    print(markdown_table(rows, COLUMNS))
    print(save("cpu-end-states", rows))


if __name__ == "__main__":
    main()
