"""The gait of a trained policy of a quadruped: which legs swing together.

    python -m benchmarks.envs.gait FOLDER

FOLDER is what `rb.envs.learning.save_policy` wrote, of a task of the Go1. For each command, 16
robots walk 6 s; of the last 3 s it writes the speed along the command and the correlation of the
thighs' angles: of the legs of a diagonal and of neighbours (both fore, both hind, same side). In a
trot the first are near 1 and the second near -1; in a pronk, with all feet at once, both are near
1. Medians over the robots that do not fall. f32. Writes results/gait-<task>-<device>.json.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.timing import markdown_table, save
from rbjax.envs.suite.go1 import FEET
from rbjax.envs.suite.go1_smooth import THIGH

#: forward and sideways speed, m/s, and yaw rate, rad/s
COMMANDS = {
    "forward": (1.0, 0.0, 0.0), "forward and turn": (0.8, 0.0, 0.8), "backward": (-0.8, 0.0, 0.0),
    "sideways": (0.0, 0.6, 0.0), "turn": (0.0, 0.0, 1.0),
}  # fmt: skip
DIAGONAL, NEIGHBOURS = ("FR RL", "FL RR"), ("FR FL", "RR RL", "FR RR", "FL RL")
ROBOTS, STEPS = 16, 300
COLUMNS = ("command", "robots", "asked", "reached", "diagonal", "neighbours")


def walk(env: Any, policy: Any, key: jax.Array, command: jax.Array) -> tuple:
    """Return (q, v, whether an episode ended) of STEPS steps under a constant command."""

    def held(state: Any) -> Any:
        return state.replace(variables={**state.variables, "command": command})

    def step(carry: tuple, key: jax.Array) -> tuple:
        obs, state = carry
        obs, state, _, done, _ = env.step(key, state, policy(obs))
        return (obs, held(state)), (state.state.q, state.state.v, done)

    one, two = jax.random.split(key)
    obs, state = env.reset(one)
    return jax.lax.scan(step, (obs, held(state)), jax.random.split(two, STEPS))[1]


def along(q: np.ndarray, v: np.ndarray, command: np.ndarray) -> float:
    """The mean speed along the command, m/s; for a turn on the spot the yaw rate, rad/s."""
    if not command[:2].any():
        return v[:, 5].mean()
    w, z = q[:, 3], q[:, 6]  # the trunk is nearly level
    yaw = 2 * np.arctan2(z, w)
    heading = np.stack([np.cos(yaw), np.sin(yaw)], -1)
    side = np.stack([-heading[:, 1], heading[:, 0]], -1)
    unit = command[:2] / np.linalg.norm(command[:2])
    return (v[:, :2] * (unit[0] * heading + unit[1] * side)).sum(-1).mean()


def row_of(name: str, command: tuple, paths: tuple) -> dict[str, Any]:
    found = []
    for q, v, done in zip(*(np.asarray(x) for x in paths), strict=True):
        if not done.any():
            q, v = q[STEPS // 2 :], v[STEPS // 2 :]
            table = np.corrcoef(q[:, [THIGH[leg] for leg in FEET]].T)
            pairs = [[table[FEET.index(a), FEET.index(b)] for a, b in map(str.split, kind)]
                     for kind in (DIAGONAL, NEIGHBOURS)]  # fmt: skip
            found.append([along(q, v, np.array(command)), *(np.mean(x) for x in pairs)])
    speed, diagonal, neighbours = np.median(found, 0).tolist() if found else [None] * 3
    asked = float(np.hypot(*command[:2]) or command[2])
    return {
        "command": name, "robots": len(found), "asked": asked, "reached": speed,
        "diagonal": diagonal, "neighbours": neighbours,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    env, policy = rb.envs.learning.load_policy(parser.parse_args().folder)
    many = jax.jit(jax.vmap(lambda key, command: walk(env, policy, key, command), (0, None)))
    keys = jax.random.split(jax.random.key(5), ROBOTS)
    rows = [row_of(name, x, many(keys, jnp.array(x))) for name, x in COMMANDS.items()]
    print(markdown_table(rows, COLUMNS))
    print(save(f"gait-{env.task.name}".replace("_", "-"), rows))


if __name__ == "__main__":
    main()
