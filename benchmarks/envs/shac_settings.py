"""Settings of SHAC side by side: trainings of one task, one after the other.

    python -m benchmarks.envs.shac_settings --task go1_joystick_flat --steps 4000000 \
        --settings '[{}, {"unclipped": true, "upright": 0.6}, {"discount": 0.99}]'

prints the curve of each setting and the return of its mean policy over whole episodes, and writes
results/shac-settings-TASK-<device>.json. A setting has changes of `rb.envs.learning.settings(TASK,
"shac")`, and of the task:

    unclipped   true: the reward of a step is dt times the sum of the terms, also below zero
    upright     least z_z of the site "imu", else the episode ends
    low         least height of the body `Task.tracked`, m, else the episode ends
    ramp        true: contacts whose force is continuous at touch

The returns are those of the task without changes. f32.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from typing import Any

import jax
import jax.numpy as jnp

import rbjax as rb
from benchmarks.shared.timing import save
from rbjax.envs.learning.training import shac_arguments

RAMP = (1e-4, 0.95, 0.02, 0.5, 2.0)  # of solimp


def changed(task: Any, setting: dict[str, Any]) -> Any:
    """Remove the changes of the task from a setting. Return the changed task."""
    ends = dict(task.terminations)
    if (least := setting.pop("upright", None)) is not None:
        ends["fallen"] = rb.envs.terms.fallen("imu", least)
    if (low := setting.pop("low", None)) is not None:
        ends["low"] = lambda t: t.after.body(task.tracked).position[2] < low
    task = dataclasses.replace(task, terminations=ends)
    if setting.pop("unclipped", False):
        task = dataclasses.replace(task, total_reward=rb.envs.sum_of_rewards)
    if setting.pop("ramp", False):
        geoms = task.model.geoms
        solimp = jnp.broadcast_to(jnp.asarray(RAMP), geoms.solimp.shape)
        model = task.model.replace(geoms=geoms.replace(solimp=solimp))
        task = dataclasses.replace(task, model=model)
    return task


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", required=True)
    parser.add_argument("--settings", default="[{}]", help="list of changes, JSON")
    parser.add_argument("--steps", type=int, default=4_000_000)
    parser.add_argument("--reports", type=int, default=10)
    parser.add_argument("--seconds", type=float, help="limit of each training")
    parser.add_argument("--episodes", type=int, default=256)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    learning, judge, rows = rb.envs.learning, rb.envs.make(given.task), []
    for setting in json.loads(given.settings):
        chosen = learning.settings(given.task, "shac") | {"steps": given.steps}
        more = dict(setting)
        env = rb.envs.Environment(changed(judge.task, more))
        began, curve = time.perf_counter(), []

        def report(
            steps: int, figures: Any, policy: Any, began: float = began, curve: Any = curve
        ) -> None:
            seconds = time.perf_counter() - began
            curve.append({"steps": steps, "seconds": seconds, **figures})
            print(f"{seconds:.0f} s, {steps}: {figures['reward']:.4g}", flush=True)

        arguments = shac_arguments(chosen | {"reports": given.reports} | more)
        found = learning.shac(
            env, jax.random.key(given.seed), report=report, seconds=given.seconds, **arguments
        )
        episodes = learning.evaluate(judge, found.policy, jax.random.key(1), given.episodes)
        returns = {"return": float(episodes.returns.mean()), "std": float(episodes.returns.std())}
        print(setting, returns, flush=True)
        rows.append({"task": given.task, "settings": setting, "curve": curve, **returns})
        save(f"shac-settings-{given.task}".replace("_", "-"), rows)


if __name__ == "__main__":
    main()
