"""Time of trainings: seconds with compiling, steps, and the curve of the reward.

    python -m benchmarks.envs.training --task go1_joystick_flat --algorithm ppo --seconds 500
    python -m benchmarks.envs.training --task cart_pole_swing_up --algorithm shac --goal 800

prints a line for each report and writes results/training-TASK-ALGORITHM-<device>.json after each,
so that a run that is cut leaves what it reached; and with --out a folder with table.csv, chart.png
and the checkpoint. f32. The clock starts before the environment is made, after the modules of the
learner are imported ("imports_s": Brax takes seconds). --goal stops the training
at a reward of an episode. --set changes a setting: --set num_envs=4096. --option changes
an option of the task: --option iterations=3. --judge names the task of the evaluation at the end,
if it is another one: go1_joystick_flat for a policy of go1_joystick_smooth. "core_seconds" is the
time of all cores of a CPU, which other processes do not lengthen much.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import time
from pathlib import Path
from typing import Any

import jax

import rbjax as rb
from benchmarks.shared.timing import markdown_table, save
from rbjax.envs.learning.proximal import ppo
from rbjax.envs.learning.report import Monitor
from rbjax.envs.learning.training import shac_arguments

COLUMNS = ("seconds", "steps", "steps_per_second", "reward", "reward_std", "length")


class GoalReached(Exception):
    """The reward of an episode is that of --goal."""


def literals(pairs: list[str]) -> dict[str, Any]:
    """Return the values of NAME=VALUE."""
    split = (pair.split("=", 1) for pair in pairs)
    return {name: ast.literal_eval(value) for name, value in split}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", required=True)
    parser.add_argument("--algorithm", default="ppo", choices=("ppo", "shac"))
    parser.add_argument("--seconds", type=float, default=540.0)
    parser.add_argument("--steps", type=int)
    parser.add_argument("--goal", type=float)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--devices", type=int, default=1)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--set", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE")
    parser.add_argument("--judge", metavar="TASK")
    parser.add_argument("--episodes", type=int, default=256, help="of the last evaluation; 0: none")
    given = parser.parse_args()
    jax.numpy.zeros(1).block_until_ready()  # the device is awake

    learning = rb.envs.learning
    imports = time.perf_counter()
    if given.algorithm == "ppo":
        importlib.import_module("brax.training.agents.ppo.train")
    began = time.perf_counter()
    options = literals(given.option)
    env = rb.envs.make(given.task, **options)
    judge = env if given.judge is None else rb.envs.make(given.judge)
    chosen = learning.settings(given.task, given.algorithm)
    chosen |= {} if given.steps is None else {"steps": given.steps}
    chosen |= literals(given.set)
    row: dict[str, Any] = {
        "task": given.task, "options": options, "judge": given.judge or given.task,
        "algorithm": given.algorithm, "seed": given.seed, "devices": given.devices,
        "settings": chosen, "imports_s": began - imports, "made_s": time.perf_counter() - began,
    }  # fmt: skip
    name = f"training-{given.task}-{given.algorithm}".replace("_", "-")
    last: dict[str, Any] = {}

    with Monitor(given.task, chosen["steps"], given.out) as monitor:

        def report(steps: int, figures: Any, policy: Any) -> None:
            monitor(steps, figures)
            last["policy"] = policy
            keep = [{k: x for k, x in r.items() if k in COLUMNS} for r in monitor.rows]
            row.update(seconds=time.perf_counter() - began, steps=steps, curve=keep)
            row["core_seconds"] = time.process_time()
            save(name, [row])
            if given.out is not None and policy is not None:
                learning.save_policy(given.out, policy, given.task, options, chosen)
            if given.goal is not None and figures["reward"] >= given.goal:
                raise GoalReached

        more = {"devices": given.devices, "seconds": given.seconds, "report": report}
        key = jax.random.key(given.seed)
        row["goal"] = given.goal
        try:
            if given.algorithm == "ppo":
                ppo(env, key, **chosen, **more)
            else:
                learning.shac(env, key, **shac_arguments(chosen), **more)
        except GoalReached:
            row["goal_reached_s"] = time.perf_counter() - began
    if given.episodes:
        found = learning.evaluate(judge, last["policy"], jax.random.key(1), given.episodes)
        row["evaluation"] = {
            "episodes": given.episodes, "return": float(found.returns.mean()),
            "std": float(found.returns.std()), "length": float(found.lengths.mean()),
            "terminated": float(found.terminated.mean()),
        }  # fmt: skip
        print(row["evaluation"])
    print(save(name, [row]))
    print(markdown_table(row["curve"], COLUMNS))


if __name__ == "__main__":
    main()
