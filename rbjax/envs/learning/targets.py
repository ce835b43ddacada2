"""Objective of the policy, and targets of the value function, over a short horizon.

    J = mean over samples and segments of  (1 - g) sum_k g^k r_k + g^n V(o_n)
    G_k = (1 - g) r_k + g ((1 - l) V(o_{k+1}) + l G_{k+1}),    G_n = V(o_n)

A segment ends at the horizon or at the end of an episode. V is zero after a termination. V is in
units of the reward of one step, by the factor 1 - g.
Source: Xu et al. 2022, section 3; Sutton & Barto, *Reinforcement learning*, 12.1.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp


def objective(
    rewards: jax.Array, values: jax.Array, done: jax.Array, ended: jax.Array, discount: float
) -> jax.Array:
    """Compute J for each sample.

    Args:
        rewards: (h, B) of each step.
        values: (h, B) V of the observation after each step, before a reset.
        done: (h, B) whether the episode ended with the step.
        ended: (h, B) whether it ended by a termination, not by its length.
        discount: g of a step.

    Returns:
        (B,)
    """
    last = jnp.zeros_like(done).at[-1].set(True)

    def one(carry: tuple, x: tuple) -> tuple:
        total, factor = carry
        r, V, done, ended, last = x
        total = total + factor * (1 - discount) * r
        factor = factor * discount
        total = total + jnp.where((done | last) & ~ended, factor * V, 0.0)
        return (total, jnp.where(done, 1.0, factor)), None

    start = (jnp.zeros_like(rewards[0]), jnp.ones_like(rewards[0]))
    return jax.lax.scan(one, start, (rewards, values, done, ended, last))[0][0]


def value_targets(
    rewards: jax.Array,
    values: jax.Array,
    done: jax.Array,
    ended: jax.Array,
    discount: float,
    td_lambda: float,
) -> jax.Array:
    """Compute the targets G (h, B) of the value function by TD(l).

    td_lambda: l; 0 for one reward and the next value, 1 for all rewards and the last value. The
    other arguments are those of `objective`.
    """

    def back(G: jax.Array, x: tuple) -> tuple:
        r, V, done, ended = x
        later = jnp.where(done, jnp.where(ended, 0.0, V), (1 - td_lambda) * V + td_lambda * G)
        G = (1 - discount) * r + discount * later
        return G, G

    return jax.lax.scan(back, values[-1], (rewards, values, done, ended), reverse=True)[1]
