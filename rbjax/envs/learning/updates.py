"""Updates of trained arrays: gradient steps that skip gradients that are not finite."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import optax

from rbjax.lanes.arrays import select


def falling_rate(rate: float, steps: int) -> Any:
    """Return a learning rate with cosine decay to a tenth."""
    return optax.cosine_decay_schedule(rate, steps, 0.1)


def policy_optimiser(rate: float, steps: int) -> Any:
    """Return Adam (0.7, 0.95) with gradients clipped to norm 1 and a falling rate."""
    return optax.chain(
        optax.clip_by_global_norm(1.0),
        optax.flatten(optax.adam(falling_rate(rate, steps), 0.7, 0.95)),
    )


def apply_update(
    optimiser: Any, slope: Any, memory: Any, numbers: Any, wanted: Any = True
) -> tuple[Any, Any, jax.Array]:
    """Update the arrays `numbers` by the gradient `slope`, if it is finite and if `wanted`.

    Returns:
        The arrays, the optimiser's state, and whether the gradient was finite.
    """
    fine = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(slope)]).all()
    slope = jax.tree.map(lambda x: jnp.where(fine, x, 0.0), slope)
    update, after = optimiser.update(slope, memory, numbers)
    moved = optax.apply_updates(numbers, update)
    numbers, memory = select(fine & wanted, (moved, after), (numbers, memory))
    return numbers, memory, fine
