"""Write the clips of the pages of tasks.

    python -m docs.generate.pictures.tasks TASK
    python -m docs.generate.pictures.tasks TASK --policy FOLDER --caption "policy by PPO"
    python -m docs.generate.pictures.tasks TASK --controller back_up --caption "a controller"
    python -m docs.generate.pictures.tasks TASK --still

FOLDER is that of `rbjax train --out FOLDER`. Without a policy the actions are random. --still draws
the robot in its reference configuration, for a task whose random actions another page shows.
docs/tasks/clips/clips.json has the captions.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

import rbjax as rb
from docs.generate.pictures.painting import TIMES, robot_frames, save
from rbjax.plotting.policies import drawn_source, record_policy, tracked_body

FOLDER = Path(__file__).parents[2] / "tasks" / "clips"
RANDOM = "Random actions, as no policy of this task is in the repository."
STILL = "The robot in its reference configuration. No policy of this task is in the repository."


def controller(name: str, env: Any) -> Any:
    """A controller of tests/envs/suite/controllers.py."""
    from tests.envs.suite import controllers

    make = getattr(controllers, name)
    return make(env) if name == "damp" else make()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("task")
    parser.add_argument("--policy", type=Path)
    parser.add_argument("--controller")
    parser.add_argument("--still", action="store_true")
    parser.add_argument("--caption")
    parser.add_argument("--speed", type=float, default=1.0, help="seconds of motion per second")
    parser.add_argument("--zoom", type=float, default=1.0)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    env = rb.envs.make(given.task)
    act: Any = None
    if given.policy is not None:
        _, policy = rb.envs.learning.load_policy(given.policy)
        act = lambda obs, key: policy(obs)  # noqa: E731
    elif given.controller is not None:
        act = controller(given.controller, env)
    if given.still:
        q = np.asarray(env.task.model.default_state().q)[None]
    else:
        times = given.speed * TIMES
        found = record_policy(env, act, seconds=float(times[-1]) + env.dt, seed=given.seed)
        at = np.searchsorted(np.asarray(found.trajectory.ts), times - 1e-9)
        q = np.asarray(found.trajectory.q[0])[np.minimum(at, len(found.trajectory.ts) - 1)]
    frames = robot_frames(
        env.task.model, q, (360, 240), source=drawn_source(env.task.model), zoom=given.zoom,
        tracked=tracked_body(env),
    )  # fmt: skip
    save(list(frames), FOLDER / f"{given.task}.webp", 150_000)
    captions = FOLDER / "clips.json"
    known = json.loads(captions.read_text()) if captions.exists() else {}
    known[given.task] = {"caption": given.caption or (STILL if given.still else RANDOM)}
    captions.write_text(json.dumps(dict(sorted(known.items())), indent=1) + "\n")


if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    main()
