"""A cart-pole task that the tests of all adapters share."""

import jax
import jax.numpy as jnp

import rbjax as rb
from rbjax import envs
from rbjax.envs import Environment, Observation, Randomisation, Reward, Task


def task(*, critic: bool = False, episode: int = 100, random: bool = False) -> Task:
    """Balance a pole on a cart; the pole's weight decides nothing, so episodes are short."""
    model = rb.load("cart_pole")

    def start(key, params):
        return rb.State(*jax.random.uniform(key, (2, 2), minval=-0.05, maxval=0.05))

    groups = {
        "policy": (
            Observation("q", lambda to: to.after.q, noise=0.001),
            Observation("v", lambda to: to.after.v, noise=0.01),
        )
    }
    if critic:
        groups["critic"] = (
            Observation("q", lambda to: to.after.q),
            Observation("v", lambda to: to.after.v),
            Observation("step", lambda to: to.step / episode),
        )
    masses = envs.random_scale("masses", lambda model: model.bodies.mass, 0.8, 1.2)
    assert isinstance(masses, Randomisation)
    return Task(
        "balance", model, start, groups,
        rewards=(
            Reward("upright", lambda to: jnp.cos(to.after.q[1]), 1.0),
            Reward("effort", lambda to: jnp.sum(to.ctrl**2), -1e-3),
        ),
        terminations={"fallen": lambda to: jnp.abs(to.after.q[1]) > 0.3},
        randomise=(masses,) if random else (),
        decimation=10, episode=episode,
    )  # fmt: skip


def environment(**options) -> Environment:
    return Environment(task(**options))
