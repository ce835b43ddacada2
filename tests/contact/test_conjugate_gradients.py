"""Contacts inside a tree, against MuJoCo and against the factorization in joint space."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.problem.articulated import ArticulatedTree
from rbjax.contact.problem.problem import Tree
from rbjax.contact.soft import detected
from rbjax.contact.solver.newton import solve

ARMS = """
<mujoco><option timestep="0.002" cone="{cone}"><flag eulerdamp="disable"/></option>
<default><geom condim="{dim}" friction="0.6 0.02 0.01"/></default>
<worldbody><geom type="plane" size="2 2 1"/>
<body pos="0 0 0.095"><freejoint/><geom type="sphere" size="0.1" mass="2"/>
  <body pos="0.1 0.15 0"><joint axis="0 0 1"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05"
    mass="0.5"/>
    <body pos="0.3 0 0.12"><joint axis="0 1 0" range="-0.2 0.2" limited="true"/>
      <geom type="sphere" size="0.06" mass="0.3"/></body></body>
  <body pos="0.1 -0.15 0.06"><joint axis="0 0 1"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05"
    mass="0.5"/></body>
</body></worldbody></mujoco>
"""
#: relative to the largest acceleration
CLOSE = {jnp.float64: 1e-11, jnp.float32: 1e-3}


def arms_of(cone: str, dim: int) -> mujoco.MjModel:
    compiled = mujoco.MjModel.from_xml_string(ARMS.format(cone=cone, dim=dim))
    compiled.opt.tolerance = 0.0
    compiled.opt.iterations = 100
    return compiled


def state_of(compiled: mujoco.MjModel, turn: float) -> mujoco.MjData:
    """Return a state whose arms are turned towards each other."""
    data = mujoco.MjData(compiled)
    data.qpos[7:] = -turn, 0.1, turn
    data.qvel[:] = np.random.default_rng(0).normal(size=compiled.nv) / 2
    mujoco.mj_forward(compiled, data)
    return data


def compare(cone: str, dim: int, dtype: type) -> None:
    """Compare accelerations with MuJoCo's, with and without a contact inside the tree."""
    compiled = arms_of(cone, dim)
    model = rb.load(compiled)

    def solutions(q, v):
        both = (detected(model, q, v, 0 * v, None, values=x) for x in (True, False))
        one, other = both
        assert isinstance(one.tree, ArticulatedTree) and isinstance(other.tree, Tree)
        return solve(one), solve(other)

    run = jax.jit(rb.threads(solutions))
    for turn, inside in ((0.32, True), (0.1, False)):
        data = state_of(compiled, turn)
        bodies = compiled.geom_bodyid[data.contact.geom]
        assert inside == bool((bodies.min(axis=1) > 0).any())
        found, direct = run(jnp.asarray(data.qpos, dtype), jnp.asarray(data.qvel, dtype))
        size = np.abs(data.qacc).max()
        np.testing.assert_allclose(found.x / size, data.qacc / size, atol=CLOSE[dtype])
        np.testing.assert_allclose(found.x / size, direct.x / size, atol=CLOSE[dtype])


def test_acceleration_equals_mujoco():
    compare("elliptic", 3, jnp.float64)


@pytest.mark.parametrize(
    ("cone", "dim", "dtype"),
    [("pyramidal", 3, jnp.float64), ("elliptic", 6, jnp.float32), ("pyramidal", 4, jnp.float32)],
)
def test_other_cones_equal_mujoco(cone, dim, dtype):
    compare(cone, dim, dtype)


def test_derivative_uses_joint_space():
    """The derivative of an acceleration with contacts inside a tree equals differences."""
    compiled = arms_of("elliptic", 3)
    model, data = rb.load(compiled), state_of(compiled, 0.32)
    q, v = jnp.asarray(data.qpos), jnp.asarray(data.qvel)
    along = jnp.asarray(np.random.default_rng(1).normal(size=compiled.nv))
    run = jax.jit(lambda v: rb.acceleration(model, rb.State(q, v)))
    rate = jax.jit(lambda v: jax.jvp(run, (v,), (along,))[1])(v)
    difference = (run(v + 1e-6 * along) - run(v - 1e-6 * along)) / 2e-6
    np.testing.assert_allclose(rate, difference, rtol=1e-6, atol=1e-5)
