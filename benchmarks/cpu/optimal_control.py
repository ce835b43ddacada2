"""Iterations of DDP beside Crocoddyl's, on one core, f64: an arm's reach and a quadrotor.

`python -m benchmarks.cpu.optimal_control --crocoddyl PYTHON` writes
results/cpu-optimal-control-<cpu>.json. PYTHON is an interpreter with crocoddyl 3.2.1, pin 4.0.0 and
example-robot-data (`pip install crocoddyl==3.2.1 pin==4.0.0 libpinocchio==4.0.0
example-robot-data`): its wheels crash with the pin 4.1 that the other benchmarks take. Both run by
turns, and each figure is the fewest CPU seconds of several solves over the number of iterations.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import argparse
import json
import subprocess
import time
from pathlib import Path
from typing import Any

import jax

from benchmarks.shared.timing import markdown_table, save
from rbjax.control import solve
from benchmarks.cases import optimal_control as oracle

PEER = str(Path(__file__).parents[1] / "shared" / "crocoddyl_peer.py")
COLUMNS = (
    "problem", "engine", "knots", "iterations", "cost", "ms an iteration", "ratio", "first_s"
)  # fmt: skip


def started(python: str | None) -> Any:
    """The peer in a process of its own, if there is an interpreter for it."""
    if python is None:
        return None
    return subprocess.Popen(
        [python, PEER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )


def answer(peer: Any, request: str) -> Any:
    """What the peer says to a line."""
    peer.stdin.write(f"{request}\n")
    peer.stdin.flush()
    return json.loads(peer.stdout.readline())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--crocoddyl", default=None, help="python with crocoddyl")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    cases = {
        "arm": oracle.kinova_reach("plain_difference"),
        "quadrotor": oracle.quadrotor(False),
    }
    peer = started(args.crocoddyl)
    rows: list[dict[str, Any]] = []
    for name, case in cases.items():
        start = time.perf_counter()
        found = jax.block_until_ready(solve(case.problem, case.start))
        first = time.perf_counter() - start
        count, ours, theirs = int(found.iterations), [], []
        for _ in range(args.rounds):
            for _ in range(3):
                begin = time.process_time()
                jax.block_until_ready(solve(case.problem, case.start).ctrl)
                ours.append((time.process_time() - begin) / count * 1e3)
            if peer:
                theirs.append(answer(peer, f"{name} 3"))
        about = {"problem": name, "knots": case.problem.horizon}
        best = min((x["ms"] for x in theirs), default=None)
        rows.append({
            **about, "engine": "rbjax", "iterations": count, "cost": float(found.cost),
            "ms an iteration": min(ours), "ratio": best and min(ours) / best, "first_s": first,
        })  # fmt: skip
        if theirs:
            rows.append({**about, "engine": "crocoddyl", "iterations": theirs[0]["iterations"],
                         "cost": theirs[0]["cost"], "ms an iteration": best})  # fmt: skip
    save("cpu-optimal-control", rows)
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
