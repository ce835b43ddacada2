"""Formulations of constrained motion on mechanisms: error, drift, cost, failures.

`python -m benchmarks.work.formulations [MECHANISM ...] [--small]`. Each motion is run by RK4 in
`rollout`, f64, one sample, with a ladder of steps; index 2, 3 and GGL by Radau IIA of order 5. The
error is the largest deviation of q, or of v against the fastest, at the end, from a closed form or
from DOP853 with "projected" and steps far smaller, whose own error is bounded by a run with half as
many. Drift is the largest residual of the rows at 10 to 320 times on the way. A step's cost is the
least of 40 runs of 100 steps, in which all formulations take turns; compile times are apart, in CPU
seconds. Results go to results/work-formulations-<device>.json and
docs/guides/figures/formulations.png; a run of some mechanisms keeps the others.
"""

from __future__ import annotations

import benchmarks.shared.one_core  # isort: skip  # noqa: F401

import argparse
import os
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

import rbjax as rb
from benchmarks.shared.timing import others, save
from benchmarks.work.formulations_chart import draw
from benchmarks.work.mechanisms import CASSIE, MECHANISMS, Mechanism
from rbjax import constraints as rc

CHUNK, SAVED, RUNGS, ROUNDS = 100, 10, 5, 40
SHOWN = 3  # the rung of the table
LOST = 0.1  # an error above this is none of accuracy
NAME = "work-formulations"


class Runs:
    """One mechanism with one formulation: a program of CHUNK steps, whose step is an argument."""

    def __init__(self, of: Mechanism, formulation: Any, integrator: str | None = "rk4"):
        self.of = of

        def chunk(state: rb.State, dt: Any) -> tuple[jax.Array, jax.Array]:
            tau = None if of.tau is None else jnp.tile(of.tau, (CHUNK, 1))
            path = rb.rollout(
                of.model, state, None, dt, tau=tau, steps=CHUNK, save_every=CHUNK // SAVED,
                integrator=integrator, constraints=formulation,
            )  # fmt: skip
            return path.q, path.v

        begin = time.process_time()
        traced = jax.jit(chunk, compiler_options=rb.compiler_options())
        self.chunk = traced.lower(of.start, jnp.asarray(1e-3)).compile()
        self.compile_s = time.process_time() - begin

    def __call__(self, chunks: int) -> tuple[np.ndarray, np.ndarray]:
        """The motion in so many chunks: q and v, (times, ...)."""
        dt = jnp.asarray(self.of.seconds / (chunks * CHUNK))
        state, seen = self.of.start, []
        for _ in range(chunks):
            seen.append(self.chunk(state, dt))
            q, v = (x[-1] for x in seen[-1])
            if not (jnp.isfinite(q).all() and jnp.isfinite(v).all()):
                break
            state = self.of.start.replace(q=q, v=v)
        return np.concatenate([q for q, _ in seen]), np.concatenate([v for _, v in seen])


def clocked(every: dict[str, Runs]) -> dict[str, float]:
    """Microseconds of a step of each: the fastest of ROUNDS chunks from the start, in turns, so
    that what else the machine does meets all of them."""
    best = dict.fromkeys(every, np.inf)
    for _ in range(ROUNDS):
        for key, runs in every.items():
            dt = jnp.asarray(runs.of.seconds / (runs.of.chunks * 2 ** (RUNGS - 1) * CHUNK))
            begin = time.perf_counter()
            jax.block_until_ready(runs.chunk(runs.of.start, dt))
            best[key] = min(best[key], 1e6 * (time.perf_counter() - begin) / CHUNK)
    return best


def apart(model: rb.Model, a: Any, b: Any) -> float:
    """The largest deviation of a coordinate, or of a velocity against the fastest (1 at least),
    between two ends (q, v)."""
    if not all(np.isfinite(x).all() for x in (*a, *b)):
        return np.inf
    dq = rb.difference(model, jnp.asarray(a[0]), jnp.asarray(b[0]))
    fastest = max(1.0, np.abs(b[1]).max())
    return float(max(np.abs(dq).max(), np.abs(np.subtract(a[1], b[1])).max() / fastest))


def last(path: Any) -> tuple[np.ndarray, np.ndarray]:
    return path[0][-1], path[1][-1]


def reference(of: Mechanism, small: bool) -> tuple[Any, float]:
    """q and v at the end, and a bound of their error."""
    if of.end is not None:
        return of.end, 0.0
    runs, chunks = Runs(of, "projected", "dop853"), of.chunks * (2 if small else 2 ** (RUNGS - 2))
    ends = last(runs(chunks)), last(runs(2 * chunks))
    return ends[1], apart(of.model, *ends)


def rows_of(name: str, formulations: dict[str, Any], small: bool) -> list[dict[str, Any]]:
    of = MECHANISMS[name]()
    end, bound = reference(of, small)
    off = jax.jit(jax.vmap(lambda q, v: rc.residual(of.model, rb.State(q, v))))
    about = {"mechanism": name, "title": of.title, "nv": of.model.nv,
             "rows": sum(c.size for c in of.model.constraints), "seconds": of.seconds}  # fmt: skip
    found: list[dict[str, Any]] = [about | {"what": "reference", "bound": bound}]
    every = {
        key: Runs(of, one, "rk4" if one.index < 2 else None) for key, one in formulations.items()
    }
    steps_us = clocked(every)
    for key, runs in every.items():
        for rung in range(2 if small else RUNGS):
            chunks = of.chunks * 2**rung
            path = runs(chunks)
            row = about | {
                "what": "run", "formulation": key, "family": formulations[key].family,
                "rung": rung, "steps": chunks * CHUNK, "compile_s": runs.compile_s,
                "step_us": steps_us[key], "load": os.getloadavg()[0],
            }  # fmt: skip
            row["us_per_second"] = row["step_us"] * row["steps"] / of.seconds
            error = apart(of.model, last(path), end)
            row["failure"] = failure(error)
            if np.isfinite(error):
                value, rate = (float(np.abs(x).max()) for x in off(*path))
                row |= {"error": error, "gap": value, "gap_rate": rate}
            found.append(row)
        say = (f"{k} {x:.2g}" for k, x in row.items() if isinstance(x, float))
        print(name, key, row["failure"] or "", *say, flush=True)
    jax.clear_caches()
    return found


def failure(error: float) -> str | None:
    """How a run failed, if it did."""
    if not np.isfinite(error):
        return "not finite"
    return "lost" if error > LOST else None


def table(rows: list[dict[str, Any]]) -> Table:
    """The rung SHOWN of each mechanism."""
    out = Table(title="The same step for all: error of q and v at the end, residuals")
    for column in ("mechanism", "formulation"):
        out.add_column(column)
    for column in ("error", "gap", "gap'", "us/step", "us/s of motion", "compile s", "also fails"):
        out.add_column(column, justify="right")
    runs = [row for row in rows if row["what"] == "run"]
    rung = min(SHOWN, max(row["rung"] for row in runs))
    before = None
    for row in runs:
        if row["rung"] != rung:
            continue
        alike = [x for x in runs if x["mechanism"] == row["mechanism"]
                 and x["formulation"] == row["formulation"]]  # fmt: skip
        failed = [f"{x['steps']}" for x in alike if x["failure"] and x["rung"] != rung]
        numbers = [row.get(k) for k in ("error", "gap", "gap_rate", "step_us", "us_per_second",
                                        "compile_s")]  # fmt: skip
        cells = ["-" if x is None else f"{x:.2g}" for x in numbers]
        cells[0] = row["failure"] or cells[0]
        if row["mechanism"] != before:
            out.add_section()
        before = row["mechanism"]
        out.add_row(row["title"], row["formulation"], *cells, ", ".join(failed))
    return out


def with_others(rows: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """With what an older run has of other mechanisms and formulations, in the order of both."""
    every = others(NAME, rows, ("mechanism", "formulation", "what")) + rows
    order = list(MECHANISMS), [None, *rc.formulations()]
    return sorted(
        every,
        key=lambda row: [
            each.index(row.get(k))
            for each, k in zip(order, ("mechanism", "formulation"), strict=True)
        ],
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("mechanisms", nargs="*", default=[], help=", ".join(MECHANISMS))
    parser.add_argument("--formulations", nargs="*", default=list(rc.formulations()))
    parser.add_argument("--small", action="store_true", help="a smoke test; nothing is saved")
    given = parser.parse_args()
    unknown = set(given.mechanisms) - MECHANISMS.keys()
    if unknown:
        parser.error(f"no such mechanism: {', '.join(sorted(unknown))}")
    asked = {name: rc.formulations()[name] for name in given.formulations}
    rows: list[dict[str, Any]] = []
    for name in given.mechanisms or MECHANISMS:
        if name == "cassie" and not CASSIE.exists():
            print(f"cassie is left out: {CASSIE} is not there")
            continue
        rows += rows_of(name, asked, given.small)
        if not given.small:
            save(NAME, with_others(rows))
    if not given.small:
        rows = with_others(rows)
        print(draw(rows))
    Console(width=150).print(table(rows))


if __name__ == "__main__":
    main()
