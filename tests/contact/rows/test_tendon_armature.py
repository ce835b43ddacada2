"""Armature of tendons, as rows of the contact problem, against MuJoCo."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.forces.tendons.tendon_weights import tendon_weights, weights_with_tendons
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY

ROBOT = """<mujoco><option integrator="{}" timestep="0.004"><flag {}/></option><worldbody>
  <geom type="plane" size="0 0 1"/><site name="anchor" pos=".4 .1 1"/>
  <body pos="0 0 .25"><joint name="a" axis="0 1 0" damping=".3"/>
    <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03" mass="1"/>
    <body pos=".4 0 0"><joint name="b" axis="0 1 .2" damping="2"/>
      <geom type="capsule" fromto="0 0 0 .3 0 -.1" size=".03" mass=".5"/>
      <site name="tip" pos=".3 0 -.1"/>
      <body pos=".3 0 -.1"><joint name="c" type="slide" axis="0 .3 1"/>
        <geom size=".05" mass=".4"/><site name="end" pos="0 .05 .1"/></body></body></body>
  </worldbody><tendon>
  <fixed name="belt" armature=".7" limited="true" range="-.2 .3"><joint joint="a" coef="1"/>
    <joint joint="b" coef="-.6"/></fixed>
  <spatial name="rope" armature="1.9"><site site="anchor"/><site site="tip"/><site site="end"/>
  </spatial></tendon>
  <actuator><motor tendon="rope" gear="2" armature=".1"/></actuator></mujoco>"""


@functools.cache
def both(integrator: str = "Euler") -> tuple[mujoco.MjModel, rb.Model]:
    m = mujoco.MjModel.from_xml_string(ROBOT.format(integrator, 'energy="enable"'))
    m.opt.tolerance, m.opt.ls_tolerance, m.opt.iterations = 0, 1e-12, 200
    return m, load_quietly(m)


def states(m: mujoco.MjModel, count: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    return rng.normal(size=(count, m.nq)) * [0.8, 0.8, 0.1], 2 * rng.normal(size=(count, m.nv))


def test_nothing_is_dropped_and_weights_are_those_of_mujoco() -> None:
    m, model = both()
    assert model.dropped == () and model.tendons.inertial == (0, 1)
    np.testing.assert_allclose(model.tendons.armature, [0.7, 2.3])
    body, dof = weights_with_tendons(model)
    np.testing.assert_allclose(body, m.body_invweight0[1:], rtol=1e-9)
    np.testing.assert_allclose(dof, m.dof_invweight0, rtol=1e-9)
    np.testing.assert_allclose(tendon_weights(model), m.tendon_invweight0, rtol=1e-9)


def test_accelerations_are_those_of_mujoco() -> None:
    m, model = both()
    d, (q, v) = mujoco.MjData(m), states(m, 30)
    u = np.linspace(-3, 3, 30)[:, None]

    def acceleration(q, v, u):
        return rb.acceleration(model, rb.State(q, v), u)

    found = np.asarray(jax.jit(jax.vmap(rb.threads(acceleration)))(*map(jnp.asarray, (q, v, u))))
    touching = 0
    for k in range(30):
        d.qpos[:], d.qvel[:], d.ctrl[:] = q[k], v[k], u[k]
        mujoco.mj_forward(m, d)
        touching += d.ncon > 0
        error = np.abs(found[k] - d.qacc).max() / (1 + np.abs(d.qacc).max())
        assert error < F64_PARITY, (k, error)
    assert touching > 3


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_steps_are_those_of_mujoco(integrator) -> None:
    """Implicit damping divides by the mass matrix with the armature of tendons."""
    m, model = both(integrator)
    d, (q, v) = mujoco.MjData(m), states(m, 1)
    d.qpos[:], d.qvel[:] = q[0], v[0]
    state = rb.State(jnp.asarray(q[0]), jnp.asarray(v[0]))
    run = rb.rollout(model, state, jnp.zeros((20, 1)), dt=0.004)
    for k in range(20):
        mujoco.mj_step(m, d)
        np.testing.assert_allclose(run.q[k + 1], d.qpos, atol=1e-9)
        np.testing.assert_allclose(run.v[k + 1], d.qvel, atol=1e-7)


def test_without_contacts_it_is_left_out() -> None:
    with pytest.warns(UserWarning, match=r"tendon armature \(belt, rope\): load\(contacts=True\)"):
        model = rb.load(ROBOT.format("Euler", 'energy="enable"'), contacts=False)
    assert any(x.startswith("tendon armature") for x in model.dropped)


def test_the_derivative_by_the_armature() -> None:
    model = both()[1]
    q, v = (jnp.asarray(x[0]) for x in states(both()[0], 1))

    def acceleration(armature):
        own = model.tendons.replace(armature=armature)
        return rb.acceleration(model.replace(tendons=own), rb.State(q, v))

    at, along, h = model.tendons.armature, jnp.asarray([1.0, -0.5]), 1e-5
    slope = jax.jvp(acceleration, (at,), (along,))[1]
    difference = (acceleration(at + h * along) - acceleration(at - h * along)) / (2 * h)
    np.testing.assert_allclose(slope, difference, rtol=1e-5, atol=1e-6)
