"""The limits that act, found in a loop, against the rows of all limits and against MuJoCo."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.contact.problem.assemble import Assembly
from rbjax.contact.rows.limit_slots import JointLimits
from tests.tolerances import F64_PARITY

CHAIN = """
<mujoco><compiler angle="radian"/><option timestep="0.002"><flag gravity="disable"/></option>
<default><geom size="0.05" contype="0" conaffinity="0"/></default>
<worldbody>
<body><joint type="slide" axis="1 0 0" range="-0.1 0.2" limited="true" margin="0.02"/>
  <geom type="sphere" mass="2"/>
  <body pos="0 0 0.3"><joint axis="0 1 0" range="0.05 0.05001" limited="true"/>
    <geom type="sphere" mass="1"/>
    <body pos="0 0 0.3"><joint axis="1 0 0" range="-0.5 0.5" limited="true"
      solreflimit="-2000 -10" solimplimit="0.5 0.8 0.01"/><geom type="sphere" mass="0.5"/>
      <body pos="0 0 0.3"><joint type="ball" range="0 0.3" limited="true"/>
        <geom type="sphere" mass="0.5"/></body>
    </body></body></body>
</worldbody></mujoco>
"""
#: coordinates of the three scalar joints, and the signs of the limits that act, by dof
STATES = {
    "none but the ball": ([0.0, 0.050005, 0.0], {}),
    "lower": ([-0.2, 0.050005, -0.6], {0: [1.0], 2: [1.0]}),
    "upper, inside the margin": ([0.19, 0.050005, 0.6], {0: [-1.0], 2: [-1.0]}),
    "all": ([0.3, 0.04, 0.7], {0: [-1.0], 1: [1.0], 2: [-1.0]}),
}


def state_of(name: str, compiled: mujoco.MjModel) -> mujoco.MjData:
    data, r = mujoco.MjData(compiled), np.random.default_rng(0)
    data.qpos[:3], turn = STATES[name][0], np.array([0.9, 0.3, -0.2, 0.1])
    data.qpos[3:], data.qvel = turn / np.linalg.norm(turn), r.normal(size=compiled.nv)
    mujoco.mj_forward(compiled, data)
    return data


def limits_at(model: rb.Model, q: jax.Array, v: jax.Array) -> JointLimits:
    return Assembly(model, q, v).problem(jnp.zeros_like(v), None).limits


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_slots_hold_the_rows_that_act(dtype: type) -> None:
    """The slots are the rows with a positive inverse regularization. The ball is not among them."""
    compiled = mujoco.MjModel.from_xml_string(CHAIN)
    model, data = rb.load(compiled), [state_of(name, compiled) for name in STATES]

    def rows_and_slots(q: jax.Array, v: jax.Array) -> tuple:
        limits = limits_at(model, q, v)
        assert limits.joints == [0, 1, 2] and limits.dofs == [0, 1, 2]
        rows = [(i, sign, x.D, x.reference) for x in limits.rows for i, sign in x.J.items()]
        return jnp.stack(
            [jnp.stack([jnp.asarray(y, dtype) for y in x]) for x in rows]
        ), limits.active()

    q, v = (jnp.stack([jnp.asarray(getattr(x, key), dtype) for x in data])
            for key in ("qpos", "qvel"))  # fmt: skip
    rows, slots = jax.jit(jax.vmap(rows_and_slots))(q, v)
    for k, (_, signs) in enumerate(STATES.values()):
        n = int(slots.length[k])
        mine = sorted(
            [float(i), *map(float, x)]
            for i, x in zip(slots.dofs[k, :n], slots.rows[k, :n], strict=True)
        )
        assert {int(x[0]): [x[1]] for x in mine} == signs and n == len(signs)
        want = sorted(map(list, np.asarray(rows[k][rows[k][:, 2] > 0], float)))
        np.testing.assert_allclose(np.array(mine), np.array(want), rtol=1e-6)


@pytest.mark.parametrize("traced", [False, True])
@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_forces_are_those_of_the_rows(dtype: type, traced: bool) -> None:
    """The joint forces by a loop over the limits that act, and their derivatives by configuration,
    velocity, acceleration and range, against all rows one by one."""
    compiled = mujoco.MjModel.from_xml_string(CHAIN)
    model, data = rb.load(compiled), [state_of(name, compiled) for name in STATES]

    def of_rows(limits: JointLimits, x: jax.Array) -> jax.Array:
        out = jnp.zeros_like(x)
        for row in limits.rows:
            f, _ = row.response(row.along(list(x)) - row.reference)
            for i, y in row.J.items():
                out = out.at[i].add(y * f)
        return out

    def in_a_loop(limits: JointLimits, x: jax.Array) -> jax.Array:
        return limits.forces(x, jax.lax.stop_gradient(limits.active().in_use))

    def both(q: jax.Array, v: jax.Array, x: jax.Array, ranges: jax.Array) -> list:
        def value(f, q, v, x, ranges):
            own = model.replace(joints=model.joints.replace(range=ranges)) if traced else model
            return f(limits_at(own, q, v), x)

        at, along = (q, v, x, ranges), (q, v, x, jnp.ones_like(ranges))
        found = []
        for f in (of_rows, in_a_loop):
            g = functools.partial(value, f)
            back = jax.vjp(g, *at)[1](v)
            found.append((jax.jvp(g, at, along), back))
        return found

    q, v = (jnp.stack([jnp.asarray(getattr(x, key), dtype) for x in data])
            for key in ("qpos", "qvel"))  # fmt: skip
    ranges = jnp.asarray(model.joints.range, dtype)
    run = jax.jit(jax.vmap(both, (0, 0, 0, None)))
    want, found = run(q, v, 3 * v, ranges)
    assert jnp.abs(want[0][0]).max() > 1.0
    close = {"rtol": 1e-9, "atol": 1e-9} if dtype == jnp.float64 else {"rtol": 1e-4, "atol": 1e-2}
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(want), strict=True):
        assert a.dtype == dtype
        np.testing.assert_allclose(a, b, **close)
    assert run(q[:0], v[:0], v[:0], ranges)[1][0][0].shape == (0, compiled.nv)


@pytest.mark.parametrize("name", STATES)
def test_acceleration_equals_mujoco(name: str) -> None:
    compiled = mujoco.MjModel.from_xml_string(CHAIN)
    compiled.opt.tolerance, compiled.opt.iterations = 0.0, 100
    data, model = state_of(name, compiled), rb.load(compiled)
    state = rb.State(jnp.asarray(data.qpos), jnp.asarray(data.qvel))
    got = jax.jit(lambda s: rb.acceleration(model, s))(state)
    scale = 1 + np.abs(data.qacc).max()
    np.testing.assert_allclose(got / scale, data.qacc / scale, atol=F64_PARITY)


def test_batches_and_derivatives() -> None:
    """Samples that touch different limits, and the derivative by the range of a joint."""
    compiled = mujoco.MjModel.from_xml_string(CHAIN)
    model, data = rb.load(compiled), [state_of(name, compiled) for name in STATES]
    q, v = (jnp.stack([jnp.asarray(getattr(x, key)) for x in data]) for key in ("qpos", "qvel"))

    def f(model: rb.Model, q: jax.Array, v: jax.Array) -> jax.Array:
        return rb.acceleration(model, rb.State(q, v))

    every = jax.jit(jax.vmap(f, (None, 0, 0)))(model, q, v)
    for k in range(len(q)):
        np.testing.assert_allclose(every[k], jax.jit(f)(model, q[k], v[k]), rtol=1e-9, atol=1e-9)
    assert jax.vmap(f, (None, 0, 0))(model, q[:0], v[:0]).shape == (0, compiled.nv)

    def moved(upper: jax.Array) -> jax.Array:
        joints = model.joints.replace(range=jnp.asarray(model.joints.range).at[2, 1].set(upper))
        return f(model.replace(joints=joints), q[3], v[3])

    h = 1e-6
    run = jax.jit(moved)
    want = (run(jnp.asarray(0.5 + h)) - run(jnp.asarray(0.5 - h))) / (2 * h)
    for derivative in (jax.jacfwd, jax.jacrev):
        np.testing.assert_allclose(
            jax.jit(derivative(moved))(jnp.asarray(0.5)), want, rtol=1e-5, atol=1e-3
        )
    assert jnp.abs(want).max() > 1.0


def test_a_robot_without_limits() -> None:
    free = CHAIN.replace('limited="true"', 'limited="false"')
    model = rb.load(mujoco.MjModel.from_xml_string(free))
    limits = limits_at(model, *(lambda s: (s.q, s.v))(model.default_state()))
    assert limits.joints == [] and limits.rows == [] and int(limits.active().length) == 0
    x = jnp.ones(model.nv)
    assert not limits.forces(x, limits.active().in_use).any()
