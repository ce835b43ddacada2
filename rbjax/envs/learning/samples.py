"""A batch of episodes that advances with a policy, differentiably, with new episodes at their ends.

A sample whose episode ends continues from an initial state that is drawn once an iteration. No
gradient passes through the end of an episode.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp


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
    env: Any, policy: Any, samples: Samples, key: jax.Array, steps: int, params: Any
) -> tuple[Samples, Path]:
    """Advance a batch under a policy."""
    batch = samples.whole.shape[0]
    once = jax.vmap(env.step_once, (0, 0, 0, None))
    first, key = jax.random.split(key)
    fresh = jax.lax.stop_gradient(
        jax.vmap(env.reset, (0, None))(jax.random.split(first, batch), params)
    )

    def move(now: Samples, key: jax.Array) -> tuple[Samples, Path]:
        one, two = jax.random.split(key)
        action = jax.vmap(policy)(now.obs, jax.random.split(one, batch))
        state, action = finite_slope((now.state, action))
        seen, state, reward, done, info = once(jax.random.split(two, batch), state, action, params)
        failed = info["failed"]
        finished = done & now.whole & ~failed
        seen = _pick(failed, jax.lax.stop_gradient(now.obs), seen)
        obs, state = _pick(done, fresh, (seen, state))
        path = Path(
            now.obs, seen, reward, done, info["terminated"] | failed, failed, finished,
            jnp.where(finished, info["return"], 0.0), jnp.where(finished, info["length"], 0),
        )  # fmt: skip
        return Samples(obs, state, now.whole | done), path

    after, path = jax.lax.scan(move, samples, jax.random.split(key, steps))
    return jax.lax.stop_gradient(after), path


def figures_of(path: Path, parts: int) -> dict[str, jax.Array]:
    """Return sums over the batch of a device; "reward" is its mean, divided by the devices."""
    return {
        "reward": path.rewards.mean() / parts,
        "return": path.finished_return.sum(),
        "length": path.finished_length.sum() * 1.0,
        "episodes": path.finished.sum() * 1.0,
        "failed": path.failed.sum() * 1.0,
    }


@jax.custom_vjp
def finite_slope(x: Any) -> Any:
    """Return x, a batch. In the gradient, samples that are not finite become zero."""
    return x


def _backward(_: None, slope: Any) -> tuple[Any]:
    numbers = [s for s in jax.tree.leaves(slope) if jnp.issubdtype(s.dtype, jnp.inexact)]
    good = jnp.stack([jnp.isfinite(s).reshape(s.shape[0], -1).all(1) for s in numbers]).all(0)
    return (jax.tree.map(
        lambda s: _pick(good, s, jnp.zeros_like(s)) if jnp.issubdtype(s.dtype, jnp.inexact) else s,
        slope,
    ),)  # fmt: skip


finite_slope.defvjp(lambda x: (x, None), _backward)


def _pick(condition: jax.Array, a: Any, b: Any) -> Any:
    """Return a for the samples (B,) whose condition is true, else b."""
    return jax.tree.map(
        lambda x, y: jnp.where(condition.reshape(-1, *[1] * (x.ndim - 1)), x, y), a, b
    )
