"""Control steps a second through the adapters to learning libraries, and of the environment itself.

    python -m benchmarks.envs.adapters --task go1_joystick_flat --batch 8192 --steps 100

writes results/adapters-TASK-<device>.json. Actions are zero, without a policy: the figures are the
share of the environment in a training. Steps of JAX libraries are one `scan`; Gymnasium's and
rsl-rl's are calls in a row, with numpy arrays on the host or with PyTorch tensors. A library that
is not installed is left out. f32.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.timing import markdown_table, save
from rbjax.errors import InputError

COLUMNS = ("interface", "batch", "compile_s", "M/s", "share")
REPEATS = 5


def scanned(first: Any, step: Callable, steps: int) -> Callable:
    """Return a function that runs `steps` steps and returns sums, so that nothing is left out."""

    def run(first: Any) -> Any:
        def one(carry: Any, key: jax.Array) -> tuple:
            carry, obs, reward = step(carry, key)
            return carry, (jax.tree.map(jnp.mean, obs), jnp.mean(reward))

        keys = jax.random.split(jax.random.PRNGKey(2), steps)
        return jax.lax.scan(one, first, keys)

    program = jax.jit(run)
    return lambda: jax.block_until_ready(program(first))


def programs(name: str, batch: int, steps: int) -> Iterator[tuple[str, Callable]]:
    """Yield the name of an interface, and a function that runs `steps` steps of a batch."""
    env = rb.envs.make(name)
    keys = jax.random.split(jax.random.PRNGKey(0), batch)
    action = jnp.zeros((batch, env.action_size))
    _, state = jax.jit(jax.vmap(env.reset))(keys)

    def bare(state: Any, key: jax.Array) -> tuple:
        obs, state, reward, _, _ = jax.vmap(env.step)(jax.random.split(key, batch), state, action)
        return state, obs, reward

    yield "environment", scanned(state, bare, steps)

    wrapped = rb.envs.adapters.wrap_brax(rb.envs.adapters.to_brax(env), env.episode)

    def brax(state: Any, key: jax.Array) -> tuple:
        state = wrapped.step(state, action)
        return state, state.obs, state.reward

    yield "Brax", scanned(jax.jit(wrapped.reset)(keys), brax, steps)

    for label, adapter in (
        ("rejax", rb.envs.adapters.to_rejax(env)),
        ("gymnax", rb.envs.adapters.to_gymnax(env)),
    ):

        def gymnax(state: Any, key: jax.Array, adapter: Any = adapter) -> tuple:
            keys, params = jax.random.split(key, batch), adapter.default_params
            obs, state, reward, *_ = jax.vmap(adapter.step, (0, 0, 0, None))(
                keys, state, action, params
            )
            return state, obs, reward

        yield label, scanned(state, gymnax, steps)

    for mode in ("next_step", "same_step"):
        envs = rb.envs.adapters.to_gymnasium_vector(env, batch, autoreset=mode)
        envs.reset(seed=0)
        zero = np.zeros((batch, env.action_size), np.float32)
        yield (
            f"Gymnasium, {mode}",
            lambda envs=envs, zero=zero: [envs.step(zero) for _ in range(steps)],
        )

    try:
        tensors = rb.envs.adapters.to_rsl_rl(env, batch)
    except InputError:
        return
    import torch

    actions = torch.zeros((batch, env.action_size), device=tensors.device)

    def rsl_rl() -> None:
        for _ in range(steps):
            reward = tensors.step(actions)[1]
        float(reward.sum())

    yield "rsl-rl", rsl_rl


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="cart_pole_balance")
    parser.add_argument("--batch", type=int, default=8192)
    parser.add_argument("--steps", type=int, default=100)
    given = parser.parse_args()
    rows: list[dict[str, Any]] = []
    for label, run in programs(given.task, given.batch, given.steps):
        times = []
        for _ in range(REPEATS + 1):
            start = time.perf_counter()
            run()
            times.append(time.perf_counter() - start)
        first, best = times[0], min(times[1:])
        rate = given.batch * given.steps / best / 1e6
        rows.append({
            "interface": label, "task": given.task, "batch": given.batch, "steps": given.steps,
            "compile_s": first - best, "run_s": best, "M/s": rate,
            "share": rate / rows[0]["M/s"] if rows else 1.0,
        })  # fmt: skip
        print(label, f"{rate:.3f} M/s", flush=True)
    print(save(f"adapters-{given.task}".replace("_", "-"), rows))
    print(markdown_table(rows, COLUMNS))


if __name__ == "__main__":
    main()
