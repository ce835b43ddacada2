"""A policy for the cart-pole's swing-up, by SHAC and by an evolution strategy.

Both begin with the same network and have the same initial states: any angle, the cart within
0.5 m, velocities within 1. They are judged on 1,000 starts within 0.5 rad of hanging: a start is
solved if, for the whole of the last second of six, the pole is within 0.1 rad of upright and the
cart within 0.5 m of the middle.

The evolution strategy (Salimans et al. 2017): theta <- theta + a / (n s) sum F_i e_i, mirrored
perturbations e_i, F_i the centred ranks of the mean rewards of whole episodes, by Adam.
"""

from __future__ import annotations

import math
import time
from typing import Any

import jax
import jax.flatten_util
import jax.numpy as jnp
import optax

import rbjax as rb

DT, EPISODE, FORCE = 0.02, 250, 10.0
SECONDS = 6.0
HIDDEN = (32, 16)
SIGMA, RATE = 0.1, 0.03  # of the evolution strategy


def environment(hanging: bool = False) -> Any:
    """The swing-up as an `Environment`. hanging: starts near hanging, and no end of an episode."""
    model = rb.load("cart_pole")
    ranges = jnp.asarray([[-FORCE, FORCE]])
    model = model.replace(actuators=model.actuators.replace(ctrlrange=ranges))

    def reward(to: Any) -> Any:
        x, angle = to.before.q
        still = (to.before.v**2).sum()
        cost = 1 - jnp.cos(angle) + 0.1 * x * x + 0.01 * still + 0.001 * (to.ctrl**2).sum()
        return 3 - cost  # positive, so that the end of an episode is no gain

    def observe(to: Any) -> Any:
        (x, angle), v = to.after.q, to.after.v
        return jnp.stack([x, jnp.sin(angle), jnp.cos(angle), 0.5 * v[0], 0.3 * v[1]])

    middle = jnp.asarray([0.0, math.pi if hanging else 0.0])
    wide = jnp.asarray([0.3, 0.5] if hanging else [0.5, math.pi])
    fast = 0.5 if hanging else 1.0

    def start(key: Any, params: Any) -> Any:
        one, two = jax.random.split(key)
        q = middle + jax.random.uniform(one, (2,), minval=-wide, maxval=wide)
        return rb.State(q, jax.random.uniform(two, (2,), minval=-fast, maxval=fast))

    return rb.envs.Environment(
        rb.envs.Task(
            "swing_up", model, start, {"policy": (rb.envs.Observation("state", observe),)},
            (rb.envs.Reward("swing_up", reward),), dt=DT, episode=EPISODE,
            terminations={} if hanging else {"off": lambda to: jnp.abs(to.after.q[0]) > 3.0},
            total_reward=lambda terms, dt: sum(terms.values()),
        )
    )  # fmt: skip


def untrained(env: Any, seed: int) -> Any:
    """The policy that both begin with, without noise."""
    return rb.envs.learning.new_policy(env, jax.random.key(seed), HIDDEN, std=None)


def success(policy: Any, count: int = 1000) -> float:
    """The share of the starts that are solved."""
    env = environment(hanging=True)
    last = round(1 / DT)

    def one(key: Any) -> Any:
        obs, state = env.reset(key)
        steps = round(SECONDS / DT) - last
        obs, state, _ = env.unroll(key, obs, state.replace(step=-steps), policy, steps)
        *_, path = env.unroll(key, obs, state, policy, last)
        x, up = path["obs"][:, 0], path["obs"][:, 2]
        return ((up > math.cos(0.1)) & (jnp.abs(x) < 0.5)).all()

    return float(jax.jit(jax.vmap(one))(jax.random.split(jax.random.key(1), count)).mean())


def by_gradients(env: Any, seed: int, iterations: int, batch: int, horizon: int = 32) -> dict:
    """Trained by `shac`: seconds with compiling, steps, success."""
    begin = time.perf_counter()
    found = rb.envs.learning.shac(
        env, jax.random.key(seed), untrained(env, seed), iterations=iterations, batch=batch,
        horizon=horizon, rate=1.5e-2, critic_rate=2e-3, critic_steps=16,
    )  # fmt: skip
    seconds = time.perf_counter() - begin
    return {
        "method": "SHAC", "seed": seed, "iterations": iterations, "batch": batch,
        "seconds": seconds, "M steps": iterations * batch * horizon / 1e6,
        "success": success(found.policy), "skipped": int(found.skipped),
        "last reward": float(found.rewards[-1]),
    }  # fmt: skip


def by_evolution(
    env: Any, seed: int, seconds: float, pairs: int, episodes: int, most: int | None = None
) -> dict:
    """Trained by the evolution strategy until `seconds`, compiling included, or `most` steps of the
    robot are over."""
    begin = time.perf_counter()
    policy = untrained(env, seed).replace(normaliser=None)
    flat, shaped = jax.flatten_util.ravel_pytree(policy.network)
    optimiser = optax.adam(RATE)

    def value(theta: Any, keys: Any) -> Any:
        acting = policy.replace(network=shaped(theta))

        def episode(key: Any) -> Any:
            obs, state = env.reset(key)
            return env.unroll(key, obs, state, acting, EPISODE)[2]["reward"].mean()

        return jax.vmap(episode)(keys).mean()

    @jax.jit
    def turn(carry: tuple) -> tuple:
        theta, memory, key = carry
        key, one, two = jax.random.split(key, 3)
        e = jax.random.normal(one, (pairs, theta.size), theta.dtype)
        e = jnp.concatenate([e, -e])
        F = jax.vmap(value, (0, None))(theta + SIGMA * e, jax.random.split(two, episodes))
        ranks = jnp.argsort(jnp.argsort(F)) / (2 * pairs - 1) - 0.5
        slope = -(ranks[:, None] * e).mean(0) / SIGMA
        update, memory = optimiser.update(slope, memory)
        return (optax.apply_updates(theta, update), memory, key), F.mean()

    carry = (flat, optimiser.init(flat), jax.random.key(seed))
    steps = 2 * pairs * episodes * EPISODE
    turns = 0
    while time.perf_counter() - begin < seconds and (most is None or turns * steps < most):
        carry, F = turn(carry)
        F.block_until_ready()
        turns += 1
    spent = time.perf_counter() - begin
    return {
        "method": "evolution strategy", "seed": seed, "iterations": turns, "batch": 2 * pairs,
        "seconds": spent, "M steps": turns * steps / 1e6,
        "success": success(policy.replace(network=shaped(carry[0]))), "last reward": float(F),
    }  # fmt: skip
