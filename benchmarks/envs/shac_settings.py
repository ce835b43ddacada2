"""Settings of SHAC side by side: several trainings of one task in one program, mapped by `vmap`.

    python -m benchmarks.envs.shac_settings --task go1_joystick_flat --batch 256 \
        --samples 6000000 --reports 24 --settings '[{"clip": 1.0}, {"clip": 0.1}]' \
        --common '{"reward_scale": 30.0, "discount": 0.97, "std": 0.15, "rate": 1e-3}'

prints the return of whole episodes of each setting over the training, and of the mean policy at
its end, and writes results/shac-settings-TASK-<device>.json. Batch, horizon and networks are common
to all settings. f32.

    rate, critic_rate   initial learning rates, with cosine decay to a tenth
    discount, trace     g and l of `rbjax.envs.learning.shac`
    slow                update of V' in an iteration
    std                 initial noise of the policy
    reward_scale        factor of the rewards
    clip                limit of the norm of the gradient
    limit               `slope_limit`
    ramp                share of the way from the contacts of the task to contacts whose force is
                        continuous at touch
    fraction            share of the training in which the ramp falls to zero; 0: never
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import time
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax

import rbjax as rb
from benchmarks.shared.timing import save
from rbjax.envs.learning import samples as moves
from rbjax.envs.learning.critic import fit_critic, follow, new_critic, weights_of
from rbjax.envs.learning.policy import new_policy, split_policy
from rbjax.envs.learning.targets import objective, value_targets
from rbjax.envs.learning.trained import summary_of
from rbjax.lanes.arrays import select

DEFAULTS = {
    "rate": 2e-3, "critic_rate": 1e-3, "discount": 0.99, "trace": 0.95, "slow": 0.5, "std": 0.35,
    "reward_scale": 1.0, "clip": 1.0, "limit": 1e9, "ramp": 0.0, "fraction": 0.0,
}  # fmt: skip
RAMP = (1e-4, 0.95, 0.02, 0.5, 2.0)  # of solimp


def softened(params: Any, share: jax.Array) -> Any:
    """Return the parameters with contacts between those of the task and those of RAMP."""
    geoms = params.model.geoms
    solimp = jnp.asarray(geoms.solimp)
    solimp = solimp + share * (jnp.asarray(RAMP, solimp.dtype) - solimp)
    return params.replace(model=params.model.replace(geoms=geoms.replace(solimp=solimp)))


def bounded(x: Any, limit: jax.Array) -> Any:
    """Return x; its gradient is finite, and that of each sample has a norm of at most limit / B."""

    @jax.custom_vjp
    def same(x: Any, limit: jax.Array) -> Any:
        return x

    def backward(limit: jax.Array, slope: Any) -> tuple:
        leaves = [s for s in jax.tree.leaves(slope) if jnp.issubdtype(s.dtype, jnp.inexact)]
        flat = jnp.concatenate([s.reshape(s.shape[0], -1) for s in leaves], 1)
        good = jnp.isfinite(flat).all(1)
        norm = jnp.linalg.norm(jnp.where(good[:, None], flat, 0.0), axis=1)
        factor = jnp.minimum(1.0, limit / len(flat) / jnp.maximum(norm, 1e-30))

        def limited(s: jax.Array) -> jax.Array:
            if not jnp.issubdtype(s.dtype, jnp.inexact):
                return s
            scaled = s * factor.reshape(-1, *[1] * (s.ndim - 1))
            return jax.vmap(select)(good, scaled, jnp.zeros_like(s))

        return jax.tree.map(limited, slope), jnp.zeros_like(limit)

    same.defvjp(lambda x, limit: (x, limit), backward)
    return same(x, limit)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", required=True)
    parser.add_argument("--settings", default="[{}]", help="list of changes of the defaults, JSON")
    parser.add_argument("--common", default="{}", help="changes of all settings, JSON")
    parser.add_argument("--samples", type=int, default=8_000_000)
    parser.add_argument("--batch", type=int, default=128)
    parser.add_argument("--horizon", type=int, default=32)
    parser.add_argument("--hidden", type=int, nargs="*", default=(128, 64))
    parser.add_argument("--critic-hidden", type=int, nargs="*", default=(128, 64))
    parser.add_argument("--critic-steps", type=int, default=16)
    parser.add_argument("--reports", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=500.0)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--option", default="{}", help="options of the task, JSON")
    parser.add_argument("--upright", type=float, help="of Go1: least z_z, else the episode ends")
    parser.add_argument("--low", type=float, help="of Go1: least height of the trunk, m")
    parser.add_argument("--name", default="")
    parser.add_argument("--out")
    given = parser.parse_args()
    began = time.perf_counter()
    env = rb.envs.make(given.task, **json.loads(given.option))
    if given.upright is not None:
        ends = {"fallen": rb.envs.terms.fallen("imu", given.upright)}
        if given.low is not None:
            ends["low"] = lambda t: t.after.body("trunk").position[2] < given.low
        env = rb.envs.Environment(dataclasses.replace(env.task, terminations=ends))
    judge = rb.envs.make(given.task, **json.loads(given.option))
    changes = [{**json.loads(given.common), **c} for c in json.loads(given.settings)]
    rows = [{**DEFAULTS, **c} for c in changes]
    hyper = {n: jnp.asarray([r[n] for r in rows], jnp.float32) for n in DEFAULTS}
    per = given.batch * given.horizon
    chunk = max(1, given.samples // per // given.reports)
    iterations = chunk * given.reports
    one, two, three = jax.random.split(jax.random.key(given.seed), 3)
    policy = new_policy(env, one, given.hidden, std=1.0)
    critic = new_critic(env, two, given.critic_hidden)
    arrays, static = eqx.partition((policy, critic), eqx.is_array)
    adam, fitter = optax.scale_by_adam(0.7, 0.95), optax.scale_by_adam()

    def fall(k: jax.Array, n: float) -> jax.Array:
        return 0.1 + 0.45 * (1 + jnp.cos(jnp.pi * k / n))

    def params_at(h: dict, k: jax.Array) -> Any:
        share = jnp.where(
            h["fraction"] > 0,
            jnp.maximum(1 - k / iterations / jnp.maximum(h["fraction"], 1e-6), 0.0), 1.0,
        )  # fmt: skip
        params = moves.at_progress(env, env.default_params, k / iterations)
        if all(r["ramp"] == 0 for r in rows):
            return params
        return softened(params, h["ramp"] * share)

    def begin(h: dict, key: jax.Array) -> tuple:
        policy, critic = eqx.combine(arrays, static)
        policy = policy.replace(log_std=jnp.log(h["std"]) + 0 * policy.log_std)
        a, b = jax.random.split(key)
        s = moves.draw_samples(env, a, given.batch, params_at(h, 0.0))
        policy, critic = policy.include(s.obs), critic.include(s.obs, lambda x: x, 1)
        trained = eqx.filter((policy, critic, critic), eqx.is_array)
        return trained, adam.init(split_policy(policy)[0]), fitter.init(weights_of(critic)), b, s

    def turn(h: dict, state: tuple, k: jax.Array) -> tuple:
        trained, memory, critic_memory, key, s = state
        acting, critic, slow = eqx.combine(trained, (*static, static[1]))
        key, other = jax.random.split(key)
        leaves, rest = split_policy(acting)

        def loss(leaves: Any) -> tuple:
            policy = eqx.combine(leaves, rest)
            moves.limit_gradient = lambda x, _: bounded(x, h["limit"])
            after, path = moves.move_samples(env, policy, s, other, given.horizon, params_at(h, k))
            values = jax.vmap(jax.vmap(slow))(path.seen)
            rewards = h["reward_scale"] * path.rewards
            J = objective(rewards, values, path.done, path.ended, h["discount"])
            return -J.mean() / (1 - h["discount"]), (after, path, values, rewards)

        slope, (s, path, values, rewards) = jax.grad(loss, has_aux=True)(leaves)
        norm = optax.global_norm(slope)
        fine = jnp.isfinite(norm)
        slope = jax.tree.map(
            lambda x: jnp.where(fine, x, 0.0) * jnp.minimum(1.0, h["clip"] / (norm + 1e-12)), slope
        )
        update, memory = adam.update(slope, memory)
        rate = h["rate"] * fall(k, iterations)
        leaves = jax.tree.map(lambda p, u: p - rate * u, leaves, update)
        targets = value_targets(rewards, values, path.done, path.ended, h["discount"], h["trace"])
        rated = optax.GradientTransformation(
            fitter.init,
            lambda g, m, p: (
                lambda u, m: (
                    jax.tree.map(lambda x: -h["critic_rate"] * fall(k, iterations) * x, u),
                    m,
                )
            )(*fitter.update(g, m)),
        )
        critic, critic_memory = fit_critic(
            critic, critic_memory, rated, path.obs, targets, given.critic_steps, lambda x: x
        )
        slow = follow(slow, critic, h["slow"])
        acting = eqx.combine(leaves, rest).include(path.obs)
        critic, slow = (c.include(path.obs, lambda x: x, 1) for c in (critic, slow))
        trained = eqx.filter((acting, critic, slow), eqx.is_array)
        figures = {**moves.figures_of(path, 1), "norm": norm, "error": jnp.std(targets - values)}
        return (trained, memory, critic_memory, key, s), figures

    @jax.jit
    def several(hyper: dict, state: tuple, ks: jax.Array) -> tuple:
        def step(state: tuple, k: jax.Array) -> tuple:
            return jax.vmap(turn, (0, 0, None))(hyper, state, k)

        return jax.lax.scan(step, state, ks)

    keys = jax.random.split(three, len(rows))
    state = jax.jit(jax.vmap(begin))(hyper, keys)
    curves: list[list] = [[] for _ in rows]
    for n in range(given.reports):
        state, figures = several(hyper, state, jnp.arange(n * chunk, (n + 1) * chunk))
        figures = jax.tree.map(np.asarray, figures)
        for i, curve in enumerate(curves):
            own = {k: x[:, i] for k, x in figures.items()}
            row = {"steps": (n + 1) * chunk * per, "seconds": time.perf_counter() - began}
            row |= summary_of(own) | {k: float(own[k].mean()) for k in ("norm", "error")}
            curve.append(row)
        print(
            f"{row['seconds']:.0f} s, {row['steps']} steps:",
            *(f"{c[-1]['reward']:.4g} ({c[-1]['length']:.0f}; |g| {c[-1]['norm']:.2g})"
              for c in curves), flush=True,
        )  # fmt: skip
        if time.perf_counter() - began > given.seconds:
            break

    @jax.jit
    def returns(trained: Any) -> jax.Array:
        policy = eqx.combine(trained, (*static, static[1]))[0]
        a, b = jax.random.split(jax.random.key(99))
        obs, state = jax.vmap(judge.reset)(jax.random.split(a, given.episodes))

        def step(carry: tuple, key: jax.Array) -> tuple:
            obs, state, on, total = carry
            act = jax.vmap(lambda o: policy(o, None))(obs)
            obs, state, r, done, _ = jax.vmap(judge.step)(
                jax.random.split(key, given.episodes), state, act
            )
            return (obs, state, on & ~done, total + jnp.where(on, r, 0.0)), None

        zero = jnp.zeros(given.episodes)
        end, _ = jax.lax.scan(step, (obs, state, zero == 0, zero), jax.random.split(b, env.episode))
        return end[-1]

    found = []
    for i, r in enumerate(rows):
        own = jax.tree.map(lambda x, i=i: x[i], state[0])
        total = np.asarray(returns(own))
        print(changes[i], f"{total.mean():.4g} +- {total.std():.3g}", flush=True)
        found.append(
            {"settings": r, "curve": curves[i], "return": float(total.mean()),
             "std": float(total.std())}
        )  # fmt: skip
        if given.out:
            eqx.tree_serialise_leaves(f"{given.out}-{i}.eqx", own)
    shown = {k: v for k, v in vars(given).items() if k not in ("settings", "common", "out")}
    name = f"shac-settings-{given.task}{given.name}".replace("_", "-")
    print(save(name, [{**shown, **row} for row in found]))


if __name__ == "__main__":
    main()
