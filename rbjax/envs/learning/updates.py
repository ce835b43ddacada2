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


def policy_optimiser(rate: float, steps: int, limit: float = 1.0) -> Any:
    """Return Adam (0.7, 0.95) with gradients clipped to the norm `limit` and a falling rate."""
    return optax.chain(
        optax.clip_by_global_norm(limit),
        optax.flatten(optax.adam(falling_rate(rate, steps), 0.7, 0.95)),
    )


def apply_update(
    optimiser: Any, gradient: Any, optimiser_state: Any, weights: Any, wanted: Any = True
) -> tuple[Any, Any, jax.Array]:
    """Update the arrays `weights` by the gradient `gradient`, if it is finite and if `wanted`.

    Returns:
        The arrays, the optimiser's state, and whether the gradient was finite.
    """
    fine = jnp.stack([jnp.isfinite(x).all() for x in jax.tree.leaves(gradient)]).all()
    gradient = jax.tree.map(lambda x: jnp.where(fine, x, 0.0), gradient)
    update, after = optimiser.update(gradient, optimiser_state, weights)
    moved = optax.apply_updates(weights, update)
    weights, optimiser_state = select(fine & wanted, (moved, after), (weights, optimiser_state))
    return weights, optimiser_state, fine
