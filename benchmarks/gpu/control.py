"""Optimal control on a GPU: iterations of DDP and SQP, of a batch of arms and of one arm.

`python -m benchmarks.gpu.control` writes results/gpu-control-<device>.json. The six-joint Indy7
reaches to points, its torques within bounds, in f32 (benchmarks/cases/optimal_control.py,
GATO's robot and weights). An iteration is what a search of 12 iterations takes longer than one of
2, over 10; both are one program. A batch of one is one problem, without `vmap`. The parts of an
iteration are timed by themselves, too: those of both methods, those of DDP only ("forward") and of
SQP only ("linear step", "trials"). One arm of 7 joints (the scene arm7) reaches over 64 knots.
"""

from __future__ import annotations

import argparse
import functools
import json
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.cases.optimal_control import given, reach, target_of
from benchmarks.shared.gpu_timing import CALLS, alone, timed
from benchmarks.shared.timing import markdown_table, measure, save
from rbjax.compiler import threads
from rbjax.control.optimal.first_guess import first_guess
from rbjax.control.optimal.shooting import ddp, expansion, sqp
from rbjax.control.optimal.shooting.search import compute_gains, initial_iterate, iterate
from rbjax.control.optimal.solution import SolveOptions, StoppingRule

COLUMNS = (
    "robot", "what", "method", "horizon", "batch", "lower_s", "compile_s", "run_s", "M/s median",
    "note",
)  # fmt: skip
LIMITS = np.array([431.97, 431.97, 197.23, 79.79, 79.79, 79.79], np.float32)


def starts(batch: int) -> tuple[rb.State, jax.Array]:
    """States (batch, ...) and targets (batch, 3)."""
    case = given("indy7_batch_reach")
    i, j = np.arange(batch)[:, None], np.arange(1, 7)
    q = np.array(case["ready"]) + 0.1 * np.sin(j * (i + 1))
    v = 0.2 * np.cos(j * (i + 1))
    f32 = functools.partial(jnp.asarray, dtype=jnp.float32)
    return rb.State(f32(q), f32(v)), f32(jax.vmap(target_of)(jnp.arange(batch)))


WAYS = {"ddp": ddp.ROLLOUTS, "sqp": sqp.LINEAR_STEPS}
MOST = 12  # iterations


class Arm(NamedTuple):
    """A robot, the site of its hand, bounds of its controls, and (model, q) -> a first guess of
    them."""

    model: rb.Model
    site: str
    bounds: Any
    guess: Any

    def given(self, N: int, state: rb.State, target: jax.Array) -> tuple:
        """A problem, and knots and controls to begin with."""
        problem = reach(self.model, N, target, self.bounds, self.site)
        us = jnp.broadcast_to(self.guess(self.model, state.q), (N, problem.nu))
        return problem, *first_guess(problem, state, None, us)


def indy7() -> Arm:
    """GATO's arm, its torques bounded."""
    model = rb.load(given("indy7_batch_reach")["model_mjcf"]).astype(jnp.float32)
    return Arm(model, "tcp", (-LIMITS, LIMITS), rb.gravity_forces)


def arm7() -> Arm:
    """An arm of seven joints with servos."""
    return Arm(rb.load("arm7").astype(jnp.float32), "tool", "model", lambda model, q: q)


def search(arm: Arm, N: int, way: str, count: jax.Array, state: rb.State, target: jax.Array) -> Any:
    """So many iterations of one problem."""
    problem, knots, us = arm.given(N, state, target)
    zero = jnp.zeros((), jnp.float32)
    options = SolveOptions(StoppingRule(zero, zero, count))
    last = iterate(WAYS[way], problem, state, knots, us, options, MOST, False)
    at = last.search
    return at.cost, at.expected_decrease, at.iterations, last.ctrl


def parts(arm: Arm, N: int) -> dict[str, Any]:
    """The parts of an iteration of one problem, as functions of its start."""

    def begun(state: rb.State, target: jax.Array) -> tuple:
        problem, knots, us = arm.given(N, state, target)
        zero = jnp.zeros((), jnp.float32)
        return problem, initial_iterate(
            problem, knots, us, StoppingRule(zero, zero, jnp.asarray(1)), 1
        )

    def expand(state: rb.State, target: jax.Array) -> Any:
        problem, now = begun(state, target)
        return expansion.expand(problem, state, now.knots, now.ctrl, now.multipliers)

    def backward(state: rb.State, target: jax.Array, found: Any) -> Any:
        problem, now = begun(state, target)
        return compute_gains(problem, now.knots, now.ctrl, found, found.gaps, now.search.reg)

    def forward(state: rb.State, target: jax.Array, found: Any, gains: Any) -> Any:
        problem, now = begun(state, target)
        return WAYS["ddp"].trials(problem, now, found, found.gaps, gains).costs

    def trials(state: rb.State, target: jax.Array, found: Any, gains: Any) -> Any:
        problem, now = begun(state, target)
        return WAYS["sqp"].trials(problem, now, found, found.gaps, gains)

    def linear(by_team: bool, state: rb.State, target: jax.Array, found: Any, gains: Any) -> Any:
        run = threads(sqp.linear_step, team=by_team)
        return run(found.path, found.gaps, gains)

    return {
        "expand": expand, "backward": backward, "forward": forward,
        "linear step": functools.partial(linear, False),
        "linear step by a team": functools.partial(linear, True), "linear step and trials": trials,
    }  # fmt: skip


def failure(error: Exception) -> str:
    """What went wrong, in short."""
    return f"{type(error).__name__}: {error}"[:200]


def iterations(about: dict[str, Any], run: Any, *given: Any, work: int) -> list[dict[str, Any]]:
    """Rows of 2 and 12 iterations, and of one."""
    rows: list[dict[str, Any]] = []
    try:
        start = time.perf_counter()
        lowered = jax.jit(run).lower(jnp.asarray(2), *given)
        lower_s = time.perf_counter() - start
        start = time.perf_counter()
        program = lowered.compile()
        compile_s = time.perf_counter() - start
        for count in (2, MOST):
            at = jnp.asarray(count)

            def calls(at: jax.Array = at) -> Any:
                return [program(at, *given) for _ in range(CALLS)][-1]

            with alone():
                times = measure(calls, budget_s=0.3, jit=False)
            done = float(jnp.mean(program(at, *given)[2]))
            rows.append({
                **about, "what": f"{count} iterations", "run_s": times["run_s"] / CALLS,
                "lower_s": lower_s, "compile_s": compile_s, "note": f"{done:.4g} done",
            })  # fmt: skip
        each = (rows[1]["run_s"] - rows[0]["run_s"]) / (MOST - 2)
        rows.append({**about, "what": "iteration", "run_s": each, "M/s median": work / each / 1e6})
    except Exception as error:  # a benchmark goes on
        rows.append({**about, "what": "iteration", "note": failure(error)})
    for row in rows:
        print(json.dumps(row), flush=True)
    return rows


def measured(arm: Arm, about: dict[str, Any], N: int, batch: int, state: Any, target: Any) -> list:
    """All rows of a horizon and a batch."""
    rows: list[dict[str, Any]] = []
    side_by_side: Any = jax.vmap
    if batch == 1:
        state, target = jax.tree.map(lambda x: x[0], (state, target))
        side_by_side = lambda f, *axes: f  # noqa: E731
    for way in WAYS:
        run = side_by_side(functools.partial(search, arm, N, way), (None, 0, 0))
        rows += iterations({**about, "method": way}, run, state, target, work=batch)
    own = parts(arm, N)
    try:
        found = jax.jit(side_by_side(own["expand"]))(state, target)
        gains = jax.jit(side_by_side(own["backward"]))(state, target, found)
    except Exception as error:  # a benchmark goes on
        return [*rows, {**about, "what": "parts", "note": failure(error)}]
    for what, f in own.items():
        given = {"expand": (), "backward": (found,)}.get(what, (found, gains))
        rows.append(timed({**about, "what": what}, side_by_side(f), state, target, *given,
                          work=batch, budget_s=0.3))  # fmt: skip
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--horizons", nargs="*", type=int, default=[64, 16])
    parser.add_argument("--batches", nargs="*", type=int, default=[1, 4096, 512])
    parser.add_argument("--seconds", type=float, default=200.0, help="no row begins after that")
    args = parser.parse_args()
    begin = time.perf_counter()
    rows = []
    seven = arm7()
    q = seven.model.default_state().q[None] + 0.3
    one = rb.State(q, jnp.zeros_like(q))
    about = {"robot": "arm7", "horizon": 64, "batch": 1}
    rows += measured(seven, about, 64, 1, one, jnp.asarray([[0.4, 0.2, 0.5]], jnp.float32))
    arm = indy7()
    for N in args.horizons:
        for batch in args.batches:
            if time.perf_counter() - begin > args.seconds:
                print(f"time is over: no rows of horizon {N}, batch {batch}", flush=True)
                continue
            about = {"robot": "indy7", "horizon": N, "batch": batch}
            rows += measured(arm, about, N, batch, *starts(batch))
            save("gpu-control", rows)
    save("gpu-control", rows)
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
