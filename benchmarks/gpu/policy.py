"""A swing-up policy by SHAC and by an evolution strategy.

`python -m benchmarks.gpu.policy [--iterations N] [--batch B] [--seeds K]` writes
results/gpu-policy-<device>.json. f32. Seconds are the wall time of training with tracing and
compiling; each seed compiles its own program. The evolution strategy has the same seconds, and in a
second row ten times as many.
"""

from __future__ import annotations

import argparse

import jax

from benchmarks.shared import policy_training as training
from benchmarks.shared.timing import markdown_table, save

COLUMNS = ("method", "seed", "iterations", "batch", "seconds", "M steps", "success", "last reward")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--iterations", type=int, default=300)
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--pairs", type=int, default=512)
    parser.add_argument("--episodes", type=int, default=8)
    parser.add_argument("--seeds", type=int, default=3)
    given = parser.parse_args()
    jax.numpy.zeros(1).block_until_ready()  # the device is awake
    env, rows = training.environment(), []
    for seed in range(given.seeds):
        rows.append(training.by_gradients(env, seed, given.iterations, given.batch))
        print(rows[-1], flush=True)
    for times in (1, 10):
        budget = times * rows[0]["seconds"]
        rows.append(training.by_evolution(env, 0, budget, given.pairs, given.episodes))
        print(rows[-1], flush=True)
    print(save("gpu-policy", rows))
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
