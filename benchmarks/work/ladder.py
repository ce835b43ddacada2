"""A ladder of step sizes: errors and times of one method on one scene, as rows.

Rows: "point", one method at one number of steps, with error and microseconds per robot and
simulated second; "error", only steps and error; "failed" and "left out" with a note on the reason.
"""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.shared.gpu_timing import alone
from benchmarks.work.scenes import (
    SAMPLE,
    SCENES,
    distance,
    prepared,
    reference,
    reference_by_cpu,
)

PRECISIONS = ("f64", "f32")
FINEST = 2e-12
ON_GPU = jax.default_backend() == "gpu"


class Bench:
    """One scene: its sample, its end, and the measured rows."""

    def __init__(
        self, name: str, deadline: float, precisions: tuple[str, ...] = PRECISIONS, end: Any = None
    ):  # end: the end of the sample, and its error bound, if they are known
        self.name, self.scene, self.deadline = name, SCENES[name], deadline
        self.precisions = precisions
        with jax.enable_x64(True):
            self.m, self.model, self.q, self.v, self.ctrl = prepared(name)
            *self.end, self.bound = end or (reference_by_cpu if ON_GPU else reference)(name)
        self.rows: list[dict[str, Any]] = [
            {"what": "reference", "scene": name, "bound": self.bound, "seconds": self.scene.seconds}
        ]

    def error(self, q: Any, v: Any) -> float:
        last = np.asarray(q[:SAMPLE]), np.asarray(v[:SAMPLE])
        return distance(self.model, last, self.end)

    def tiled(self, batch: int) -> tuple[jax.Array, jax.Array]:
        """The starts, repeated, in the current precision."""
        times = -(-batch // SAMPLE)
        return tuple(jnp.tile(jnp.asarray(x, float), (times, 1))[:batch] for x in (self.q, self.v))

    def add(self, what: str, engine: str, method: str, precision: str, **row: Any) -> None:
        row = {"what": what, "scene": self.name, "engine": engine, "method": method,
               "precision": precision} | row  # fmt: skip
        self.rows.append(row)
        if "steps" not in row:
            self.say(row)

    def say(self, row: dict[str, Any]) -> None:
        short = {k: f"{x:.3g}" if isinstance(x, float) else x for k, x in row.items()}
        print(*short.values(), flush=True)

    def guarded(self, engine: str, method: str, precision: str, work: Callable) -> None:
        """Runs the work of a method. A failure becomes a row, and the benchmark continues."""
        if time.monotonic() > self.deadline:
            self.add("left out", engine, method, precision, note="out of time")
            return
        try:
            with jax.enable_x64(precision == "f64"):
                work()
        except Exception as error:
            traceback.print_exc()
            note = f"{type(error).__name__}: {str(error)[:200]}"
            self.add("failed", engine, method, precision, note=note)

    def ladder(
        self, engine: str, method: str, precision: str, run: Callable[[int], Any],
        stages: float | None, batch: int, first: int, most_s: float, what: str = "point",
        rungs: Iterator[int] | None = None,
    ) -> None:  # fmt: skip
        """Points at growing numbers of steps (`rungs`, of a compiled program), until the error is
        at its floor or time is up; with force evaluations, if the stages a step are known."""
        errors: list[float] = []
        begin = time.perf_counter()
        if rungs is None:
            jax.block_until_ready(run(first))
        compile_s = time.perf_counter() - begin
        for steps in rungs or _growing(first):
            if time.monotonic() > self.deadline:
                break
            seconds, last = clocked(run, steps, what == "point")
            errors.append(self.error(*last))
            each = 1e6 * seconds / batch / self.scene.seconds
            row = {"steps": steps, "error": errors[-1], "batch": batch, "run_s": seconds}
            if stages is not None:
                row["evaluations"] = stages * steps / self.scene.seconds
            if what == "point":
                row["us"] = each
            self.add(what, engine, method, precision, **row)
            floor = len(errors) > 3 and min(errors[-2:]) > 0.7 * min(errors[:-2])
            if errors[-1] < FINEST or (floor and errors[-1] < 1e-2) or 1.5 * seconds > most_s:
                break
        self.say(self.rows[-1] | {"first": compile_s})


def _growing(first: int) -> Iterator[int]:
    """first times 1, 2, 3, 4, 6, 8, 12, 16, ..."""
    k = first
    while True:
        yield k
        if k > first:
            yield 3 * k // 2
        k *= 2


def clocked(run: Callable[[int], Any], steps: int, often: bool) -> tuple[float, Any]:
    """The time of the fastest of a few runs, and the result of the last one."""
    best, spent, count = float("inf"), 0.0, 0
    enough = 0.05 if ON_GPU else 0.3
    with alone():
        while count == 0 or (often and count < 20 and spent < enough):
            begin = time.perf_counter()
            last = jax.block_until_ready(run(steps))
            best = min(best, time.perf_counter() - begin)
            spent, count = spent + time.perf_counter() - begin, count + 1
    return best, last
