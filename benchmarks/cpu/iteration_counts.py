"""Iterations of DDP or SQP until it is as good as Crocoddyl's answer, from the same start; f64.

`python -m benchmarks.cpu.iteration_counts [--crocoddyl PYTHON]` writes
results/cpu-iteration-counts-<cpu>.json. The problems are those of tests/oracles, whose file has
Crocoddyl's answers and iterations. `to their cost` is the iteration that is as good as where
Crocoddyl stops, `to 6 digits` the one that is as good as the optimum that ours ends at. With an
interpreter that has Crocoddyl (`benchmarks.cpu.optimal_control` says which), its iterations to the
same digits of its own optimum of the quadrotors are counted too.
"""

import benchmarks.shared.one_core  # noqa: F401, I001 (before jax)

import argparse
import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from benchmarks.cpu.optimal_control import answer, started
from benchmarks.shared.timing import markdown_table, save
from rbjax.control import solve
from benchmarks.cases import optimal_control as oracle

DIGITS = 1e-6
COLUMNS = ("problem", "method", "cost", "iterations", "to 6 digits", "to their cost",
           "their cost", "their iterations", "theirs to 6 digits")  # fmt: skip
#: problem, method, and Crocoddyl's cost where it stops by default
CASES: dict[str, tuple[Callable[[], oracle.Case], str, float]] = {
    "arm, wrapped angles": (
        functools.partial(oracle.kinova_reach, "as_in_crocoddyl"), "ddp", 8.125078008410737),
    "arm": (
        functools.partial(oracle.kinova_reach, "plain_difference"), "ddp", 6.8988188339428005),
    "arm to rest": (
        functools.partial(oracle.kinova_reach, "plain_with_terminal_velocity"), "ddp",
        8.0195984379492),
    "double pendulum": (oracle.double_pendulum, "exact_sqp", 0.02058750842288562),
    "double pendulum by DDP": (oracle.double_pendulum, "exact_ddp", 0.02058750842288562),
    "quadrotor": (functools.partial(oracle.quadrotor, False), "exact_ddp", 0.005208641329765494),
    "bounded quadrotor": (
        functools.partial(oracle.quadrotor, True), "exact_ddp", 0.006512949757359135),
    "cart-pole": (functools.partial(oracle.cart_pole, "near_upright"), "ddp", 4.843614219835456),
}  # fmt: skip


def reached(costs: np.ndarray, due: float) -> int | None:
    """The first iteration whose cost is that one to six digits, or lower."""
    good = costs <= due * (1 + DIGITS)
    return int(np.argmax(good)) + 1 if good.any() else None


def row(name: str, peer: Any) -> dict[str, Any]:
    make, method, theirs = CASES[name]
    case = make()
    found = solve(case.problem, case.start, method=method, iterations=300)
    count = int(found.iterations)
    costs = np.asarray(found.costs)[:count]
    due = theirs
    if "quadrotor" in name:  # the same share above the optimum: its velocities are those of bodies
        listed = "quadrotor_pose_bounded" if "bounded" in name else "quadrotor_pose"
        due = float(found.cost) * theirs / oracle.given(listed)["se3"]["cost"]
    out = {
        "problem": name, "method": method, "cost": float(found.cost), "iterations": count,
        "to 6 digits": reached(costs, float(found.cost)), "to their cost": reached(costs, due),
        "their cost": theirs, "their iterations": case.iterations,
    }  # fmt: skip
    if peer and "quadrotor" in name:
        more = np.asarray(answer(peer, f"{name} costs"))[1:]  # the first is that of the start
        out["theirs to 6 digits"] = reached(more, float(more.min()))
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--crocoddyl", default=None, help="python with crocoddyl")
    asked = parser.parse_args()
    peer = started(asked.crocoddyl)
    rows = []
    for name in CASES:
        rows.append(row(name, peer))
        print(rows[-1], flush=True)
    print(save("cpu-iteration-counts", rows))
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
