"""Returns of a trained policy in rbjax and in MuJoCo C, and with other options of its task.

    python -m benchmarks.envs.policies FOLDER --physics rbjax mujoco
    python -m benchmarks.envs.policies FOLDER --option randomise=True --episodes 1000

FOLDER is what `rb.envs.learning.save_policy` wrote. The task has the options of --option only, not
those of the training. MuJoCo C runs the task's robot file with its solver settings, so the task
must not randomise its model. f32. Writes results/policies-<device>.json, and keeps the rows of
other policies and options.
"""

from __future__ import annotations

import argparse
import ast
import json
from importlib import resources
from pathlib import Path
from typing import Any

import jax
import mujoco

import rbjax as rb
from benchmarks.shared.timing import markdown_table, others, save

NAME, KEYS = "policies", ("task", "trained with", "options", "physics")
COLUMNS = (*KEYS, "episodes", "return", "std", "upright")


def robot_file(task: str, dt: float) -> mujoco.MjModel:
    """MuJoCo's model of the robot of a task, such as g1.xml of "g1_joystick"."""
    file = resources.files("rbjax.envs") / "robots" / f"{task.split('_')[0]}.xml"
    model = mujoco.MjModel.from_xml_path(str(file))
    model.opt.timestep = dt
    return model


def written(options: dict[str, Any]) -> str:
    """Options as in a call: "iterations=3, randomise=True"."""
    return ", ".join(f"{name}={value}" for name, value in options.items())


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--physics", nargs="+", default=["rbjax"], choices=("rbjax", "mujoco"))
    parser.add_argument("--episodes", type=int, default=128)
    parser.add_argument("--option", action="append", default=[], metavar="NAME=VALUE")
    given = parser.parse_args()
    trained, policy = rb.envs.learning.load_policy(given.folder)
    options = {n: ast.literal_eval(x) for n, x in (o.split("=", 1) for o in given.option)}
    training = written(json.loads((given.folder / "policy.json").read_text())["options"])
    task, rows = trained.task.name, []
    env = rb.envs.make(task, **options)
    for physics in given.physics:
        key = jax.random.key(1)
        if physics == "rbjax":
            found = rb.envs.learning.evaluate(env, policy, key, given.episodes)
        else:
            there = robot_file(task, float(env.task.model.timestep))
            found = rb.validation.evaluate_in_mujoco(env, policy, there, key, given.episodes)
        rows.append({
            "task": task, "trained with": training, "options": written(options),
            "physics": {"rbjax": "rbjax", "mujoco": "MuJoCo C"}[physics],
            "episodes": given.episodes, "return": float(found.returns.mean()),
            "std": float(found.returns.std()), "upright": 1 - float(found.terminated.mean()),
        })  # fmt: skip
        print(rows[-1], flush=True)
    print(markdown_table(rows, COLUMNS), save(NAME, rows + others(NAME, rows, KEYS)), sep="\n")


if __name__ == "__main__":
    main()
