"""A small cart-pole task for the tests of learners."""

import jax
import jax.numpy as jnp

import rbjax as rb
from rbjax.envs import Environment, Observation, Reward, Task

KEY = jax.random.key(0)


def start(key, params):
    return rb.State(0.3 * jax.random.normal(key, (2,)), jnp.zeros(2))


def upright(to):
    effort = 0.1 * (to.after.v**2).sum() + 1e-3 * (to.ctrl**2).sum()
    return jnp.cos(to.after.q[1]) - effort


def observe(to):
    return jnp.concatenate([to.after.q, to.after.v])


def environment(**more):
    fields = {
        "start": start,
        "observations": {"policy": (Observation("state", observe),)},
        "rewards": (Reward("upright", upright),),
        "dt": 0.05,
        "episode": 5,
        "total_reward": lambda terms, dt: sum(terms.values()),
    } | more
    return Environment(Task("pole", rb.load("cart_pole"), **fields))
