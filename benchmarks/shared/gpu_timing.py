"""Timing for processes that share an accelerator: they compile in parallel and run in turn.

Each benchmark is one call: `python -m benchmarks.gpu.threads [--robots ...]`.
A row holds lower, compile and run seconds (`timing.measure`) and millions a second.
"""

from __future__ import annotations

import argparse
import contextlib
import fcntl
import json
import os
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax

from benchmarks.shared.robots import ALL
from benchmarks.shared.timing import markdown_table, measure, save

LOCK = Path(os.environ.get("RBJAX_GPU_LOCK", "/tmp/rbjax-gpu.lock"))
COLUMNS = ("what", "robot", "engine", "batch", "lower_s", "compile_s", "run_s", "M/s median", "M/s")
COLUMNS += ("error median", "error max", "note")


#: calls in a row; only the last one is waited for, which hides the overhead of a call
CALLS = 5


def _in_a_row(program: Callable) -> Callable:
    def calls(*args: Any) -> Any:
        for _ in range(CALLS - 1):
            program(*args)
        return program(*args)

    return calls


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Exclusive use of the device, among the benchmarks on this machine."""
    with LOCK.open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def timed(row: dict[str, Any], fn: Callable, *args: Any, work: int, budget_s: float = 0.5) -> dict:
    """The row with the times of `fn`; `work` is the number of evaluations or steps of a call."""
    try:
        start = time.perf_counter()
        lowered = jax.jit(fn).lower(*args)
        lower_s = time.perf_counter() - start
        start = time.perf_counter()
        program = lowered.compile()
        compile_s = time.perf_counter() - start
        with alone():
            times = measure(_in_a_row(program), *args, budget_s=budget_s, jit=False)
        times |= {key: times[key] / CALLS for key in ("run_s", "run_min_s")}
        row = row | times | {"lower_s": lower_s, "compile_s": compile_s}
        row["M/s"] = work / times["run_min_s"] / 1e6
        row["M/s median"] = work / times["run_s"] / 1e6
    except Exception as error:  # a benchmark goes on
        row = row | {"note": f"{type(error).__name__}: {str(error)[:150]}"}
        if os.environ.get("RBJAX_TRACEBACK"):
            traceback.print_exc()
    print(json.dumps(row), flush=True)
    return row


def options(description: str) -> argparse.Namespace:
    """The command line options of every benchmark."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("--robots", nargs="*", default=list(ALL))
    parser.add_argument("--batches", nargs="*", type=int, default=None)
    parser.add_argument("--tag", default="")
    return parser.parse_args()


def finish(name: str, rows: list[dict[str, Any]]) -> None:
    """Save and print."""
    save(name, rows)
    print(markdown_table(rows, COLUMNS))
