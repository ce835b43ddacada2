"""A policy for the cart-pole's swing-up, trained through the dynamics and by an evolution strategy.

Both begin with the same network and see the same starts: any angle, the cart within 0.5 m,
velocities within 1. They are judged on 1,000 starts near hanging (`shared.swing_up`): a start is
solved where, for the whole of the last second of six, the pole is within 0.1 rad of upright and the
cart within 0.5 m of the middle.

The evolution strategy (Salimans et al. 2017): theta <- theta - a / (n s) sum F_i e_i, mirrored
perturbations e_i, F_i the centred ranks of the mean costs of whole episodes, by Adam.
"""

from __future__ import annotations

import time
from typing import Any

import equinox as eqx
import jax
import jax.flatten_util
import jax.numpy as jnp
import optax

import rbjax as rb
from benchmarks.shared.swing_up import starts, tasks

DT, EPISODE, FORCE = 0.02, 250, 10.0
SECONDS = 6.0
SIZES = (5, 32, 16, 1)
SIGMA, RATE = 0.1, 0.03  # of the evolution strategy


def environment() -> Any:
    """The swing-up as an `Environment`."""
    model = rb.load("cart_pole")
    ranges = jnp.asarray([[-FORCE, FORCE]])
    model = model.replace(actuators=model.actuators.replace(ctrlrange=ranges))

    def cost(state: Any, ctrl: Any) -> Any:
        x, angle = state.q
        still = (state.v**2).sum()
        return 1 - jnp.cos(angle) + 0.1 * x * x + 0.01 * still + 0.001 * (ctrl**2).sum()

    def observe(state: Any) -> Any:
        x, angle = state.q
        return jnp.stack([x, jnp.sin(angle), jnp.cos(angle), 0.5 * state.v[0], 0.3 * state.v[1]])

    def start(key: Any) -> Any:
        one, two = jax.random.split(key)
        wide = jnp.asarray([0.5, jnp.pi])
        q = jax.random.uniform(one, (2,), minval=-wide, maxval=wide)
        return rb.State(q, jax.random.uniform(two, (2,), minval=-1.0, maxval=1.0))

    return rb.control.Environment(
        model, cost, start, dt=DT, observe=observe, episode=EPISODE,
        lost=lambda state: jnp.abs(state.q[0]) > 3.0,
    )  # fmt: skip


def untrained(seed: int) -> Any:
    """The network that both begin with."""
    return rb.control.network(jax.random.key(seed), SIZES)


def success(env: Any, policy: Any, count: int = 1000) -> float:
    """The share of the starts that are solved."""
    states = starts(tasks()["cart_pole"], count, seed=1)
    run = rb.rollout(env.model, states, env.controller(policy), DT, steps=int(SECONDS / DT))
    q = run.q[:, -int(1 / DT) :]
    held = (jnp.cos(q[..., 1]) > jnp.cos(0.1)) & (jnp.abs(q[..., 0]) < 0.5)
    return float(held.all(1).mean())


def by_gradients(env: Any, seed: int, iterations: int, batch: int, horizon: int = 32) -> dict:
    """Trained by `actor_critic`: seconds with compiling, steps, success."""
    begin = time.perf_counter()
    found = rb.control.actor_critic(
        env, untrained(seed), jax.random.key(seed), iterations=iterations, batch=batch,
        horizon=horizon, rate=1.5e-2, value_rate=2e-3, value_steps=16,
    )  # fmt: skip
    jax.block_until_ready(found.costs)
    seconds = time.perf_counter() - begin
    return {
        "method": "actor_critic", "seed": seed, "iterations": iterations, "batch": batch,
        "seconds": seconds, "M steps": iterations * batch * horizon / 1e6,
        "success": success(env, found.policy), "skipped": int(found.skipped),
        "last cost": float(found.costs[-1]),
    }  # fmt: skip


def by_evolution(
    env: Any, seed: int, seconds: float, pairs: int, episodes: int, most: int | None = None
) -> dict:
    """Trained by the evolution strategy until `seconds`, compiling included, or `most` steps of the
    robot are over."""
    begin = time.perf_counter()
    numbers, rest = eqx.partition(untrained(seed), eqx.is_inexact_array)
    flat, shaped = jax.flatten_util.ravel_pytree(numbers)
    optimiser = optax.adam(RATE)

    def value(theta: Any, states: Any) -> Any:
        policy = eqx.combine(shaped(theta), rest)
        costs = env.unroll(policy, None, states, EPISODE).costs
        return jnp.where(jnp.isfinite(costs), jnp.minimum(costs, 100.0), 100.0).mean()

    @jax.jit
    def turn(carry: tuple) -> tuple:
        theta, memory, key = carry
        key, one, two = jax.random.split(key, 3)
        e = jax.random.normal(one, (pairs, theta.size), theta.dtype)
        e = jnp.concatenate([e, -e])
        _, states = jax.vmap(env.reset)(jax.random.split(two, episodes))
        F = jax.vmap(value, (0, None))(theta + SIGMA * e, states)
        ranks = jnp.argsort(jnp.argsort(F)) / (2 * pairs - 1) - 0.5
        slope = (ranks[:, None] * e).mean(0) / SIGMA
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
    policy = eqx.combine(shaped(carry[0]), rest)
    return {
        "method": "evolution strategy", "seed": seed, "iterations": turns, "batch": 2 * pairs,
        "seconds": spent, "M steps": turns * steps / 1e6, "success": success(env, policy),
        "last cost": float(F),
    }  # fmt: skip
