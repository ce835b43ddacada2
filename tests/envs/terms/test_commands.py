"""Commands: their distributions, and when they change."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs import terms
from rbjax.errors import InputError

PARAMS = SimpleNamespace(values={
    "command_range": jnp.array([1.5, 0.8, 1.2]), "command_on": jnp.array([0.9, 0.25, 0.5]),
    "command_time": 5.0, "command_low": jnp.array([-1.0, -0.5, -1.0]),
    "command_high": jnp.array([1.0, 0.5, 2.0]), "command_stop": 0.1,
})  # fmt: skip


def run(variables, steps, seed=0):
    """The command and the steps that are left, after each of some steps."""

    def begin(key):
        keys = jax.random.split(key, len(variables))
        return {v.name: v.start(k, PARAMS) for v, k in zip(variables, keys, strict=True)}

    def step(old, key):
        new = dict(old)
        for v, k in zip(variables, jax.random.split(key, len(variables)), strict=True):
            new[v.name] = v.update(k, SimpleNamespace(variables=dict(new), params=PARAMS))
        return new, new

    @jax.jit
    @jax.vmap
    def path(key):
        first, rest = jax.random.split(key)
        return jax.lax.scan(step, begin(first), jax.random.split(rest, steps))[1]

    return jax.tree.map(np.asarray, path(jax.random.split(jax.random.key(seed), 400)))


def test_switched_commands():
    path = run(terms.switched_commands(0.02), 600)
    c, left = path["command"], path["command_steps"]
    changed = (c[:, 1:] != c[:, :-1]).any(-1)
    drawn = left[:, :-1] <= 1
    assert not (changed & ~drawn).any()  # it changes only if the time is over
    # a rate of 1 in 250 steps; with 400 * 599 steps the estimate is within 10 %
    assert abs(drawn.mean() * 250 - 1) < 0.1
    assert (abs(c) <= [1.5, 0.8, 1.2]).all()
    # of the entries that are drawn again, one half, the part 1 - b becomes zero
    moved = (c[:, 1:] != c[:, :-1])[drawn]
    before, after = c[:, :-1][drawn], c[:, 1:][drawn]
    zero = ((after == 0) & (before != 0)).sum(0) / (before != 0).sum(0)
    assert np.allclose(zero, 0.5 * (1 - np.array([0.9, 0.25, 0.5])), atol=0.08)
    due = 0.5 * np.array([0.9, 0.25, 0.5])  # and the part b a new number
    assert np.allclose((moved & (after != 0)).mean(0), due, atol=0.08)


def test_periodic_commands():
    path = run(terms.periodic_commands(10), 35)
    c = path["command"]
    changed = (c[:, 1:] != c[:, :-1]).any(-1)
    assert set(np.flatnonzero(changed.any(0)) + 2) == {10, 20, 30}  # steps counted from 1
    zero = (c == 0).all(-1)
    assert abs(zero.mean() - 0.1) < 0.03
    assert (c >= [-1.0, -0.5, -1.0]).all() and (c <= [1.0, 0.5, 2.0]).all()
    assert np.allclose(c[~zero].mean(0), [0, 0, 0.5], atol=0.1)


def test_a_command_of_two_entries():
    model = rb.load("quadruped")
    task = rb.envs.Task(
        "small", model, start=lambda key, params: model.default_state(),
        observations={"policy": (rb.envs.Observation("v", lambda to: to.after.v),)},
        rewards=(rb.envs.Reward("turn", terms.track_yaw_rate("trunk")),),
        variables=(rb.envs.Variable("command", lambda key, params: jnp.zeros(2)),),
    )  # fmt: skip
    with pytest.raises(InputError, match="'command' of the task has 2 entries"):
        rb.envs.Environment(task)
