"""Contacts inside a tree, against MuJoCo and against the factorization in joint space."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.problem.articulated import ArticulatedTree
from rbjax.contact.problem.assemble import Assembly
from rbjax.contact.problem.problem import Tree
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
        both = (Assembly(model, q, v, iterative=x).problem(0 * v, None) for x in (True, False))
        one, other = (x.detect() for x in both)
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


def problem_of(cone: str, turn: float):
    """Return a number that depends on the acceleration as a function of the angles of the arms, the
    velocity and friction, an argument, and a direction."""
    compiled = arms_of(cone, 3)
    model, data = rb.load(compiled), state_of(compiled, turn)
    r = np.random.default_rng(1)
    weights, along = (jnp.asarray(r.normal(size=n)) for n in (compiled.nv, 3 + compiled.nv + 1))
    base = jnp.asarray(data.qpos[:7])

    def scalar(x):
        angles, v, friction = x[:3], x[3:-1], x[-1]
        geoms = model.geoms
        geoms = geoms.replace(friction=jnp.asarray(geoms.friction) * friction)
        state = rb.State(jnp.concatenate([base, angles]), v)
        return weights @ rb.acceleration(model.replace(geoms=geoms), state)

    return scalar, jnp.asarray([*data.qpos[7:], *data.qvel, 1.0]), along


def test_derivative_inside_a_tree_equals_differences():
    scalar, x, along = problem_of("elliptic", 0.32)
    run = jax.jit(lambda x: (jax.jvp(scalar, (x,), (along,)), jax.grad(scalar)(x)))
    (_, rate), slope = run(x)
    a, b = (run(x + e * along)[0][0] for e in (1e-6, -1e-6))
    np.testing.assert_allclose(rate, (a - b) / 2e-6, rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(slope @ along, rate, rtol=1e-10)


@pytest.mark.parametrize("turn", [0.32, 0.1])
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
def test_second_derivatives_equal_differences(cone, turn):
    """Forward over reverse, with and without contacts inside the tree."""
    scalar, x, along = problem_of(cone, turn)
    run = jax.jit(lambda x: jax.jvp(jax.grad(scalar), (x,), (along,)))
    _, second = run(x)
    g, h = (run(x + e * along)[0] for e in (1e-6, -1e-6))
    np.testing.assert_allclose(second, (g - h) / 2e-6, rtol=1e-5, atol=1e-4)
    assert jnp.abs(second).max() > 1e-2


def test_reverse_at_a_cotangent_of_zero():
    """A right-hand side of zero ends conjugate gradients at once, and gives a zero gradient."""
    compiled = arms_of("elliptic", 3)
    model, data = rb.load(compiled), state_of(compiled, 0.32)
    q, v = jnp.asarray(data.qpos), jnp.asarray(data.qvel)
    run = lambda v: rb.acceleration(model, rb.State(q, v))  # noqa: E731
    back = jax.jit(lambda v, bar: jax.vjp(run, v)[1](bar)[0])
    assert not back(v, jnp.zeros_like(v)).any()
    change = jax.jit(lambda v, bar: jax.jvp(lambda b: back(v, b), (0 * bar,), (bar,))[1])
    np.testing.assert_allclose(change(v, v), back(v, v), rtol=1e-9, atol=1e-9)
