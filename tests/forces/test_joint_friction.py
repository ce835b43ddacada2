"""Smooth friction against MuJoCo's friction loss, as the width of its step goes to zero."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.forces.against_mujoco import applied, costs_nothing, slopes
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, GRADIENT

# a joint that gravity pulls with 3 m/s^2 or rad/s^2, friction holding up to 5 of its inertia
DRY = """
<mujoco><option gravity="3 0 0" timestep="1e-4" integrator="RK4"/><worldbody>
<body gravcomp="{held}"><joint name="j" {joint} frictionloss="{loss}"
  solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001"/>
<inertial pos="0 0 0" mass="2" diaginertia="0.5 0.5 0.5"/></body>
</worldbody>{more}</mujoco>
"""
SLIDE = DRY.format(joint='type="slide" axis="1 0 0"', loss=10, held=0, more="")
HINGE = DRY.format(
    joint='axis="1 0 0"',
    loss=2.5,
    held=0,
    more='<actuator><motor joint="j" gear="1.5"/></actuator>',
)
LIMBS = """
<mujoco><default><geom contype="0" conaffinity="0" size="0.1" pos="0.1 0 0.05"/></default>
<worldbody>
  <body><joint name="hinge" frictionloss="0.3"/><geom/>
    <body pos="0.2 0 0"><joint name="slide" type="slide"/><geom/>
      <body pos="0.2 0 0"><joint name="ball" type="ball" frictionloss="0.2"/><geom/></body></body>
  </body>
</worldbody></mujoco>
"""


def smoothed(model: rb.Model, v_0: float) -> rb.Model:
    (friction,) = model.forces
    return model.replace(forces=(friction.replace(smoothing=jnp.full(1, v_0)),))


@pytest.mark.parametrize("text", [SLIDE, HINGE], ids=["slide", "hinge"])
def test_acceleration_while_sliding(text: str) -> None:
    """What is missing from Coulomb's friction is F_c (1 - tanh(v / v_0)), exponentially small."""
    m = mujoco.MjModel.from_xml_string(text)
    model, data, v = load_quietly(m, friction=True), mujoco.MjData(m), 0.3
    data.qvel, data.ctrl = v, 1.0
    mujoco.mj_forward(m, data)
    ratio = model.forces[0].coulomb[0] / (5 * model.forces[0].coulomb[0]) * 25  # 5 per inertia

    @jax.jit
    def error(v_0):
        state = rb.State(jnp.zeros(1), jnp.full(1, v))
        changed = smoothed(model, 1.0).forces[0].replace(smoothing=v_0[None])
        tau = rb.applied_forces(model.replace(forces=(changed,)), state, jnp.ones(m.nu))
        return rb.forward_dynamics(model, state.q, state.v, tau)[0] - data.qacc[0]

    widths = np.array([0.3, 0.15, 0.1, 0.05, 0.01])
    found = np.array([error(x) for x in widths])
    np.testing.assert_allclose(found, ratio * (1 - np.tanh(v / widths)), atol=1e-6)
    assert abs(found[-1]) < 1e-6


def test_a_motion_that_comes_to_rest_converges_with_order_one() -> None:
    """It slides for a second, and is then held under a load: from there on it creeps with v_0."""
    m = mujoco.MjModel.from_xml_string(SLIDE)
    model, data = load_quietly(m, friction=True), mujoco.MjData(m)
    data.qvel = 2.0
    for _ in range(20_000):
        mujoco.mj_step(m, data)
    assert abs(data.qpos[0] - 1.0) < 2e-3  # v^2 / (2 (5 - 3))
    start = rb.State(jnp.zeros(1), jnp.full(1, 2.0))

    @jax.jit
    @jax.vmap
    def end(v_0):
        changed = model.forces[0].replace(smoothing=v_0[None])
        moving = model.replace(forces=(changed,))
        return rb.rollout(moving, start, steps=2000, dt=1e-3, integrator="rk4").q[-1, 0]

    errors = np.asarray(end(jnp.array([0.08, 0.04, 0.02]))) - data.qpos[0]
    rates = np.log2(errors[:-1] / errors[1:])
    assert np.all(np.abs(rates - 1) < 0.1), rates
    np.testing.assert_allclose(errors / [0.08, 0.04, 0.02], np.arctanh(3 / 5), rtol=0.1)


def test_it_creeps_as_mujoco_does() -> None:
    """The step's width that `load` chooses, with MuJoCo's own softness, beside MuJoCo's creep."""
    text = SLIDE.replace('solimpfriction="0.9999 0.9999 0.001"', "").replace("0.002 1", "0.02 1")
    m = mujoco.MjModel.from_xml_string(text)
    model, data = load_quietly(m, friction=True), mujoco.MjData(m)
    for _ in range(3000):
        mujoco.mj_step(m, data)
    v_0 = float(model.forces[0].smoothing[0])
    np.testing.assert_allclose(v_0 * 3 / 5, data.qvel[0], rtol=1e-3)


def test_every_kind_of_joint() -> None:
    model = load_quietly(LIMBS, friction=True)
    (friction,) = model.forces
    assert friction.joints == (0, 2) and not any("friction" in word for word in model.dropped)
    np.testing.assert_array_equal(friction.coulomb, [0.3, 0.2, 0.2, 0.2])
    n, at = 20, np.array([0, 2, 3, 4])
    q = np.tile(model.joints.reference, (n, 1))
    v = np.random.default_rng(0).normal(size=(n, model.nv))
    want = np.zeros_like(v)
    want[:, at] = -np.array(friction.coulomb) * np.tanh(v[:, at] / np.array(friction.smoothing))
    np.testing.assert_allclose(applied(model)(q, v, np.zeros((n, 0))), want, atol=F64_PARITY)


def test_the_law() -> None:
    model = rb.load("cart_pole")
    given = {"breakaway": 3.0, "stribeck": 0.2, "smoothing": 1e-3, "viscous": 0.5}
    friction = rb.forces.JointFriction.of(model, model.joint_names, [2.0, 1.0], **given)
    v = jnp.array([0.3, -0.1])
    tau = rb.applied_forces(model.with_forces(friction), rb.State(jnp.zeros(2), v))
    own = rb.applied_forces(model, rb.State(jnp.zeros(2), v))
    dry = np.array([2.0, 1.0]) + np.array([1.0, 2.0]) * np.exp(-((v / 0.2) ** 2))
    np.testing.assert_allclose(tau - own, -dry * np.sign(v) - 0.5 * v, rtol=1e-12)

    def f(at):
        element, v = at
        return rb.applied_forces(model.replace(forces=(element,)), rb.State(jnp.zeros(2), v))

    smooth = friction.replace(smoothing=jnp.full(2, 0.1))
    for speed in (v, 0 * v, 30 * v):
        assert slopes(f, (smooth, speed)) < GRADIENT


def test_only_where_asked_for_and_enabled() -> None:
    assert load_quietly(SLIDE).forces == ()
    for flag in ("frictionloss", "constraint"):
        off = SLIDE.replace('"RK4"/>', f'"RK4"><flag {flag}="disable"/></option>')
        assert rb.load(off, friction=True).forces == ()
    assert rb.load("double_pendulum", friction=True).forces == ()


def test_the_numbers_are_those_of_a_model() -> None:
    with pytest.raises(rb.InputError, match=r"JointFriction.of: model is 'cart_pole', expect"):
        rb.forces.JointFriction.of("cart_pole", ["slider"], 1.0)  # type: ignore[arg-type]


def test_zeros_cost_nothing() -> None:
    model = rb.load("double_pendulum")
    none = rb.forces.JointFriction.of(model, model.joint_names, 0.0)
    assert costs_nothing(none, model)
