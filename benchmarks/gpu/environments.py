"""Environment steps a second, with noise, rewards and resets, beside the bare rollout.

    python -m benchmarks.gpu.environments --tasks cart_pole_balance go1_joystick_flat
    python -m benchmarks.gpu.environments --tasks hopper_hop hopper_hop:touch=false --batch 65536

All tasks run if none is given. Parts:
    step     a scan over vmapped `env.step` with random actions; rewards and ends are kept
    kept     the same, and observations and actions are kept, as a learner of Brax keeps them
    unroll   `env.unroll` with a random policy: all steps are one kernel
    rollout  `rb.rollout` of the same robots from the same states with the same controls, without
             anything of the task
"share" is the rate of a part over that of the rollout. "M/s" counts control steps; "physics M/s"
counts steps of the integrator. "lower_s" and "compile_s" of "step" are those of a first call;
"kept" has the same kernel, which is not compiled again. The timed steps begin where as many steps
have led the robots from their resets. It writes results/gpu-environments-<device>. f32.
"""

from __future__ import annotations

import argparse
import json
import time
import warnings
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.gpu_timing import timed
from benchmarks.shared.timing import markdown_table, others, save

PARTS = ("step", "kept", "unroll", "rollout")
COLUMNS = ("task", "what", "batch", "observation", "decimation", "lower_s", "compile_s", "run_s")
COLUMNS += ("M/s median", "M/s", "physics M/s", "share", "note")


def make(text: str) -> rb.envs.Environment:
    """The environment of a name, or of name:option=value,option=value."""
    name, _, options = text.partition(":")
    given = dict(x.split("=") for x in options.split(",") if x)
    return rb.envs.make(name, **{key: json.loads(value) for key, value in given.items()})


def random_actions(env: rb.envs.Environment, key: jax.Array, shape: tuple[int, ...]) -> jax.Array:
    """Uniform actions in their range; of an infinite one within 1 of its finite end, or of 0."""
    low, high = (np.asarray(x, np.float32) for x in env.action_range)
    low, high = np.where(np.isfinite(low), low, -1.0), np.where(np.isfinite(high), high, 1.0)
    return jax.random.uniform(key, (*shape, env.action_size), jnp.float32, low, high)


def scanned(env: rb.envs.Environment, keep: Callable) -> Callable:
    """A function (obs, state, keys, actions) that steps a batch; `keep` chooses what it returns of
    each step."""

    def steps(obs: Any, state: Any, keys: jax.Array, actions: jax.Array) -> Any:
        def one(carry: tuple, given: tuple) -> tuple:
            obs, state = carry
            after, state, reward, done, info = jax.vmap(env.step)(given[0], state, given[1])
            kept = {"obs": obs, "action": given[1], "reward": reward, "done": done}
            kept |= {"truncated": info["truncated"], "ctrl": state.ctrl}
            return (after, state), keep(kept)

        return jax.lax.scan(one, (obs, state), (keys, actions))

    return steps


def compiled(f: Callable, *args: Any) -> tuple[Any, dict[str, float]]:
    """The compiled program, and the seconds of tracing and compiling."""
    start = time.perf_counter()
    lowered = jax.jit(f).lower(*args)
    middle = time.perf_counter()
    program = lowered.compile()
    return program, {"lower_s": middle - start, "compile_s": time.perf_counter() - middle}


def few(kept: dict[str, Any]) -> Any:
    return kept["reward"], kept["done"]


def all_of_brax(kept: dict[str, Any]) -> Any:
    return [kept[name] for name in ("obs", "action", "reward", "done", "truncated")]


def bench(text: str, batch: int, steps: int, parts: tuple[str, ...]) -> list[dict[str, Any]]:
    env = make(text)
    task = env.task
    data = jax.random.split(jax.random.key(0), 5)
    keys = jax.random.split(data[0], (2, steps, batch))
    actions = random_actions(env, data[1], (2, steps, batch))
    obs, state = jax.jit(jax.vmap(env.reset))(jax.random.split(data[2], batch))
    begin, times = compiled(scanned(env, few), obs, state, keys[0], actions[0])
    (obs, state), _ = begin(obs, state, keys[0], actions[0])
    keys, actions = keys[1], actions[1]
    recorded = jax.jit(scanned(env, lambda kept: (kept["ctrl"], kept["done"])))
    _, (ctrl, done) = recorded(obs, state, keys, actions)
    ctrl = jnp.moveaxis(ctrl, 0, 1)  # (batch, steps, nu); after a reset that of the new episode

    def policy(obs: Any, key: jax.Array) -> jax.Array:
        return random_actions(env, key, ())

    def unrolled(keys: jax.Array, obs: Any, state: Any) -> Any:
        run = lambda key, obs, state: env.unroll(key, obs, state, policy, steps)  # noqa: E731
        obs, state, path = jax.vmap(run)(keys, obs, state)
        return obs, state, path["reward"], path["done"]

    def bare(state: rb.State, ctrl: jax.Array) -> Any:
        held = jnp.repeat(ctrl, task.decimation, axis=1)
        count = held.shape[1]
        return rb.rollout(
            task.model, state, held, task.dt or task.model.timestep, steps=count,
            save_every=count, integrator=task.integrator, contact=task.contact,
        ).q[:, -1]  # fmt: skip

    programs: dict[str, tuple] = {
        "step": (scanned(env, few), obs, state, keys, actions),
        "kept": (scanned(env, all_of_brax), obs, state, keys, actions),
        "unroll": (unrolled, keys[0], obs, state),
        "rollout": (bare, state.state, ctrl),
    }
    rows = []
    for part in parts:
        row = {"task": text, "what": part, "batch": batch, "decimation": task.decimation}
        row |= {"observation": env.observation_size, "ends": float(done.mean())}
        f, *given = programs[part]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            row = timed(row, f, *given, work=batch * steps)
        row |= times if part == "step" else {}
        if "M/s" in row:
            row["physics M/s"] = row["M/s"] * task.decimation
        rows.append(row)
    alone = [row.get("M/s") for row in rows if row["what"] == "rollout"]
    for row in rows:
        if alone and alone[0] and row["what"] != "rollout" and "M/s" in row:
            row["share"] = row["M/s"] / alone[0]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=[], help="names, or name:option=value")
    parser.add_argument("--batch", type=int, default=8192)
    parser.add_argument("--steps", type=int, default=50, help="control steps of one timed call")
    parser.add_argument("--parts", nargs="+", default=PARTS, choices=PARTS)
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for text in given.tasks or rb.envs.tasks():
        try:
            rows += bench(text, given.batch, given.steps, tuple(given.parts))
        except Exception as error:  # the other tasks go on
            rows.append({"task": text, "note": f"{type(error).__name__}: {str(error)[:150]}"})
        done = [*rows, *others("gpu-environments", rows, ("task", "what", "batch"))]
        save("gpu-environments", done)
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
