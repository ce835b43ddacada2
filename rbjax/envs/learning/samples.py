"""A batch of episodes that advances with a policy, differentiably, with new episodes at their ends.

A sample whose episode ends continues from an initial state that is drawn once an iteration. No
gradient passes through the end of an episode.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from rbjax.envs.batch_step import batch_step
from rbjax.envs.checks import check_params
from rbjax.lanes.arrays import select


class Samples(NamedTuple):
    """The batch between two iterations: observations, `EnvState`, and whether the present episode
    began at its beginning (B,)."""

    obs: Any
    state: Any
    whole: jax.Array


class Path(NamedTuple):
    """What a batch did in a horizon, each (h, B, ...).

    obs: observations before each step. seen: after each step, before a reset; finite.
    done: the episode ended. ended: by a termination or a failure. failed: by a state that is not
    finite. finished: a whole episode ended, with its return and length, else 0.
    """

    obs: Any
    seen: Any
    rewards: jax.Array
    done: jax.Array
    ended: jax.Array
    failed: jax.Array
    finished: jax.Array
    finished_return: jax.Array
    finished_length: jax.Array


def draw_samples(env: Any, key: jax.Array, batch: int, params: Any) -> Samples:
    """Draw the first batch. Episodes begin at random times, so that they do not end together."""
    one, two = jax.random.split(key)
    obs, state = jax.vmap(env.reset, (0, None))(jax.random.split(one, batch), params)
    step = jax.random.randint(two, (batch,), 0, env.episode, state.step.dtype)
    return Samples(obs, state.replace(step=step), step == 0)


def move_samples(
    env: Any,
    policy: Any,
    samples: Samples,
    key: jax.Array,
    steps: int,
    params: Any,
    gradient_limit: float | None = None,
) -> tuple[Samples, Path]:
    """Advance a batch under a policy. gradient_limit: of `limit_gradient`, in each step."""
    batch = samples.whole.shape[0]
    once = jax.vmap(env.step_once, (0, 0, 0, None))

    def step(keys: jax.Array, state: Any, action: jax.Array) -> tuple:
        return once(keys, *limit_gradient((state, action), gradient_limit), params)

    first, key = jax.random.split(key)
    fresh = jax.lax.stop_gradient(
        jax.vmap(env.reset, (0, None))(jax.random.split(first, batch), params)
    )

    def move(now: Samples, key: jax.Array) -> tuple[Samples, Path]:
        _, moved = batch_step(policy, step, now.obs, now.state, key, batch)
        seen, state, reward, done, info = moved
        failed = info["failed"]
        finished = done & now.whole & ~failed
        seen = jax.vmap(select)(failed, jax.lax.stop_gradient(now.obs), seen)
        obs, state = jax.vmap(select)(done, fresh, (seen, state))
        path = Path(
            now.obs, seen, reward, done, info["terminated"] | failed, failed, finished,
            jnp.where(finished, info["return"], 0.0), jnp.where(finished, info["length"], 0),
        )  # fmt: skip
        return Samples(obs, state, now.whole | done), path

    after, path = jax.lax.scan(move, samples, jax.random.split(key, steps))
    return jax.lax.stop_gradient(after), path


def at_progress(env: Any, params: Any, progress: Any) -> Any:
    """Return the parameters at a progress in 0..1 of the training, by the task's curriculum."""
    curriculum = env.task.curriculum
    if curriculum is None:
        return params
    found = curriculum(params, progress)
    check_params(env.task.name, found, params, "the result of the curriculum")
    return found


def figures_of(path: Path, parts: int) -> dict[str, jax.Array]:
    """Return sums over the batch of a device; "reward" is its mean, divided by the devices."""
    return {
        "reward": path.rewards.mean() / parts,
        "return": path.finished_return.sum(),
        "length": path.finished_length.sum() * 1.0,
        "episodes": path.finished.sum() * 1.0,
        "failed": path.failed.sum() * 1.0,
    }


@functools.partial(jax.custom_vjp, nondiff_argnums=(1,))
def limit_gradient(x: Any, limit: float | None) -> Any:
    """Return x, a batch. In the gradient, samples that are not finite become zero, and the gradient
    of each sample is scaled to a norm of at most limit / B."""
    return x


def _backward(limit: float | None, _: None, gradient: Any) -> tuple[Any]:
    leaves = [s for s in jax.tree.leaves(gradient) if jnp.issubdtype(s.dtype, jnp.inexact)]
    flat = jnp.concatenate([s.reshape(s.shape[0], -1) for s in leaves], 1)
    good = jnp.isfinite(flat).all(1)
    factor = jnp.ones_like(flat[:, 0])
    if limit is not None:
        norm = jnp.linalg.norm(jnp.where(good[:, None], flat, 0.0), axis=1)
        factor = jnp.minimum(1.0, limit / len(flat) / jnp.maximum(norm, 1e-30))

    def limited(s: jax.Array) -> jax.Array:
        if not jnp.issubdtype(s.dtype, jnp.inexact):
            return s
        scaled = s * factor.reshape(-1, *[1] * (s.ndim - 1))
        return jax.vmap(select)(good, scaled, jnp.zeros_like(s))

    return (jax.tree.map(limited, gradient),)


limit_gradient.defvjp(lambda x, limit: (x, None), _backward)
