"""Optimal control on a GPU: iterations of DDP a second, a batch of six-joint arms, and one arm.

`python -m benchmarks.gpu.control` writes results/gpu-control-<device>.json. The six-joint Indy7
reaches to points, its torques within bounds, in f32 (problems of tests/oracles/optimal_control.py,
GATO's robot and weights). An iteration is what a search of 12 iterations takes longer than one of
2, over 10. The parts of an iteration are timed by themselves, too.
"""

from __future__ import annotations

import argparse
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.gpu_timing import timed
from benchmarks.shared.timing import markdown_table, save
from rbjax.control import ddp
from rbjax.control.forward_pass import forward_pass
from rbjax.control.front_door import first_guess
from rbjax.control.options import Options
from rbjax.threads import threads
from tests.oracles.optimal_control import given, reach, target_of

COLUMNS = ("what", "horizon", "batch", "lower_s", "compile_s", "run_s", "M/s median", "note")
LIMITS = np.array([431.97, 431.97, 197.23, 79.79, 79.79, 79.79], np.float32)


def starts(batch: int) -> tuple[rb.State, jax.Array]:
    """States (batch, ...) and targets (batch, 3)."""
    case = given("indy7_batch_reach")
    i, j = np.arange(batch)[:, None], np.arange(1, 7)
    q = np.array(case["ready"]) + 0.1 * np.sin(j * (i + 1))
    v = 0.2 * np.cos(j * (i + 1))
    f32 = functools.partial(jnp.asarray, dtype=jnp.float32)
    return rb.State(f32(q), f32(v)), f32(jax.vmap(target_of)(jnp.arange(batch)))


def search(model: rb.Model, N: int, count: int, state: rb.State, target: jax.Array) -> Any:
    """So many iterations of one problem: cost and gap."""
    problem = reach(model, N, target, (-LIMITS, LIMITS))
    tau = rb.gravity_forces(model, state.q)
    knots, us = first_guess(problem, state, None, jnp.broadcast_to(tau, (N, 6)))
    zero = jnp.zeros((), jnp.float32)
    options = Options(zero, zero, jnp.asarray(count))
    last = ddp.optimised(problem, state, knots, us, options, count, False)
    return last.cost, last.stop, last.turns, last.ctrls


def parts(model: rb.Model, N: int, state: rb.State, target: jax.Array) -> dict[str, Any]:
    """Expansion, backward pass and forward passes of one problem, as functions of its start."""
    del state, target

    def expand(state: rb.State, target: jax.Array) -> Any:
        problem = reach(model, N, target, (-LIMITS, LIMITS))
        knots, us = first_guess(problem, state)
        begin = ddp._begun(problem, knots, us, Options(*jnp.zeros(3)), 1)
        return ddp.expand(problem, state, knots, us, begin.multipliers)

    def backward(state: rb.State, target: jax.Array, found: Any) -> Any:
        problem = reach(model, N, target, (-LIMITS, LIMITS))
        knots, us = first_guess(problem, state)
        return ddp.gains_of(problem, knots, us, found, found.gaps, jnp.float32(1e-9))

    def forward(state: rb.State, target: jax.Array, gains: Any, gaps: jax.Array) -> Any:
        problem = reach(model, N, target, (-LIMITS, LIMITS))
        knots, us = first_guess(problem, state)
        begin = ddp._begun(problem, knots, us, Options(*jnp.zeros(3)), 1)
        lengths = jnp.asarray([0.5**k for k in range(ddp.TRIALS)], jnp.float32)
        run = threads(functools.partial(forward_pass, problem))
        return jax.vmap(run, (None,) * 5 + (0,))(
            knots, us, gains, gaps, begin.multipliers, lengths
        ).cost

    return {"expand": expand, "backward": backward, "forward": forward}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--horizons", nargs="*", type=int, default=[16, 64])
    parser.add_argument("--batches", nargs="*", type=int, default=[1, 512, 4096])
    args = parser.parse_args()
    model = rb.load(given("indy7_batch_reach")["model_mjcf"]).astype(jnp.float32)
    rows = []
    for N in args.horizons:
        for batch in args.batches:
            state, target = starts(batch)
            own = parts(model, N, state, target)
            about = {"horizon": N, "batch": batch}
            found = jax.jit(jax.vmap(own["expand"]))(state, target)
            gains = jax.jit(jax.vmap(own["backward"]))(state, target, found)
            rows.append(timed({"what": "expand", **about}, jax.vmap(own["expand"]), state, target,
                              work=batch))  # fmt: skip
            rows.append(timed({"what": "backward", **about}, jax.vmap(own["backward"]), state,
                              target, found, work=batch))  # fmt: skip
            rows.append(timed({"what": "forward", **about}, jax.vmap(own["forward"]), state, target,
                              gains, found.gaps, work=batch))  # fmt: skip
            times = {}
            for count in (2, 12):
                run = jax.vmap(functools.partial(search, model, N, count))
                row = timed({"what": f"{count} iterations", **about}, run, state, target,
                            work=batch * count)  # fmt: skip
                rows.append(row)
                times[count] = row.get("run_s", np.nan)
            each = (times[12] - times[2]) / 10
            rate = batch / each / 1e6
            rows.append({"what": "iteration", **about, "run_s": each, "M/s median": rate})
            print(rows[-1], flush=True)
    save("gpu-control", rows)
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
