"""The gradient of a return through contacts: against differences, and against its secants.

    JAX_ENABLE_X64=1 python -m benchmarks.envs.return_gradient --tasks hopper_run go1_joystick_flat

An offset x (na,) is added to every action of h steps with random actions, from states of such a
motion, and R(x) is the sum of the terms' rewards times dt, not clipped. For each h:

    difference    median of |g . e - (R(+s e) - R(-s e)) / 2 s| over that of the second, s = 1e-6
    secant        correlation over samples and directions of g . e with the same, s = 0.2
    norm          median of |g| and its 95th percentile
    noise         standard deviation of the mean gradient of the samples over its norm

e are random unit vectors. Writes results/return-gradient-<device>.json. f64.
"""

from __future__ import annotations

import argparse
import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import rbjax as rb
from benchmarks.shared.timing import markdown_table, save

SMALL, LARGE, DIRECTIONS, BEFORE = 1e-6, 0.2, 4, 50


def rows(name: str, horizons: list[int], count: int, std: float) -> list[dict[str, Any]]:
    """The figures of a task for each horizon."""
    task = dataclasses.replace(rb.envs.make(name).task, total_reward=rb.envs.sum_of_rewards)
    env, longest = rb.envs.Environment(task), max(horizons)
    params = env.default_params.replace(noise=0.0)
    once = jax.vmap(env.step_once, (0, 0, 0, None))
    draw = jax.vmap(env.reset, (0, None))
    shape = (longest + BEFORE, count, env.action_size)
    noise = std * jax.random.normal(jax.random.key(0), shape)

    def move(state: Any, noise: jax.Array, x: Any) -> tuple:
        def one(state: Any, noise: jax.Array) -> tuple:
            keys = jax.random.split(jax.random.key(1), count)
            _, state, reward, *_ = once(keys, state, x + noise, params)
            return state, reward

        return jax.lax.scan(one, state, noise)

    _, state = draw(jax.random.split(jax.random.key(2), count), params)
    state = jax.jit(move)(state, noise[longest:], 0.0)[0]

    @jax.jit
    def R(x: jax.Array) -> jax.Array:
        return jnp.cumsum(move(state, noise[:longest], x)[1], 0)

    slope = jax.jit(jax.grad(lambda x, h: (R(x) * (jnp.arange(longest) == h - 1)[:, None]).sum()))
    e = jax.random.normal(jax.random.key(3), (DIRECTIONS, count, env.action_size))
    e /= jnp.linalg.norm(e, axis=2, keepdims=True)
    small, large = ((jax.lax.map(R, s * e) - jax.lax.map(R, -s * e)) / (2 * s)
                    for s in (SMALL, LARGE))  # fmt: skip
    found = []
    for h in horizons:
        g = np.asarray(slope(jnp.zeros(shape[1:]), h))
        own = (g * np.asarray(e)).sum(2).ravel()
        exact, secant = np.asarray(small[:, h - 1]).ravel(), np.asarray(large[:, h - 1]).ravel()
        norms, mean = np.linalg.norm(g, axis=1), np.linalg.norm(g.mean(0))
        found.append({
            "task": name, "steps": h, "samples": count, "std": std,
            "difference": float(np.median(np.abs(own - exact)) / np.median(np.abs(exact))),
            "secant": float(np.corrcoef(own, secant)[0, 1]),
            "norm": float(np.median(norms)), "norm, 95 %": float(np.percentile(norms, 95)),
            "noise": float(np.linalg.norm(g.std(0)) / np.sqrt(count) / mean),
        })  # fmt: skip
    return found


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", default=["hopper_run", "go1_joystick_flat"])
    parser.add_argument("--horizons", type=int, nargs="+", default=[1, 4, 16, 32])
    parser.add_argument("--samples", type=int, default=64)
    parser.add_argument("--std", type=float, default=0.2, help="of the random actions")
    given = parser.parse_args()
    found = []
    for name in given.tasks:
        found += rows(name, given.horizons, given.samples, given.std)
        print(markdown_table(found, tuple(found[0])), flush=True)
    print(save("return-gradient", found))


if __name__ == "__main__":
    main()
