"""Samples a second of PPO (Brax) on one and on several devices, evaluations and compiling left out.

    python -m benchmarks.envs.devices --task go1_joystick_flat --devices 1 2 --scales 1 2

A scale is a factor of the robots and of the batches of the task's settings. With a scale equal to
the number of devices each device has the work of one; with 1 the devices share it. "over one" is
the rate over that of one device at the first scale. Each training has --reports reports with
--iterations iterations of PPO each; the rate is that of the fastest report after the first, which
compiles. It writes results/gpu-devices-TASK-<device>.json. f32.
"""

from __future__ import annotations

import argparse
import itertools
import time
from typing import Any

import jax

import rbjax as rb
from benchmarks.shared.timing import markdown_table, save

COLUMNS = ("devices", "scale", "num_envs", "first_s", "M samples/s", "over one")


def rate(
    env: rb.envs.Environment, settings: dict[str, Any], devices: int, iterations: int, reports: int
) -> dict[str, float]:
    """Train for some reports. Return the seconds to the first one, and the rate of the fastest."""
    per_iteration = settings["batch_size"] * settings["num_minibatches"] * settings["unroll_length"]
    settings = settings | {"steps": per_iteration * iterations * reports, "reports": reports}
    times = [(time.perf_counter(), 0)]

    def report(steps: int, figures: Any, policy: Any) -> None:
        times.append((time.perf_counter(), steps))

    rb.envs.learning.ppo(
        env, jax.random.key(0), **settings, devices=devices, report=report, run_evals=False
    )
    rates = [
        (steps - before) / (t - last)
        for (last, before), (t, steps) in itertools.pairwise(times[1:])
    ]
    return {"first_s": times[1][0] - times[0][0], "M samples/s": max(rates) / 1e6}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="go1_joystick_flat")
    parser.add_argument("--devices", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--scales", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--iterations", type=int, default=5)
    parser.add_argument("--reports", type=int, default=4)
    given = parser.parse_args()
    env = rb.envs.make(given.task)
    rows: list[dict[str, Any]] = []
    for devices, scale in zip(given.devices, given.scales, strict=True):
        settings = rb.envs.learning.settings(given.task, "ppo")
        for name in ("num_envs", "batch_size"):
            settings[name] *= scale
        row = {"task": given.task, "devices": devices, "scale": scale}
        row |= {"num_envs": settings["num_envs"]}
        row |= rate(env, settings, devices, given.iterations, given.reports)
        rows.append(row)
        row["over one"] = row["M samples/s"] / rows[0]["M samples/s"]
        print(row, flush=True)
        save(f"gpu-devices-{given.task}".replace("_", "-"), rows)
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
