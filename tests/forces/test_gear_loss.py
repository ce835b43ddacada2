"""What gears lose, in closed form, and beside the regressor's column."""

import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from rbjax import sysid
from rbjax.errors import InputError

ARM = """
<mujoco><worldbody><body><joint name="a" damping="0.3" armature="0.02"/>
<inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.02 0.03"/>
<body pos="0.2 0 0"><joint name="b" axis="0 1 0"/>
<inertial pos="0.1 0 0" mass="1" diaginertia="0.01 0.02 0.03"/></body></body></worldbody>
<actuator><motor name="a" joint="a" gear="3"/><motor name="b" joint="b"/></actuator></mujoco>
"""
MODEL = rb.load(ARM)


def lost(gear, v, ctrl):
    state = rb.State(jnp.zeros(2), jnp.asarray(v))
    with_gear = rb.applied_forces(MODEL.with_forces(gear), state, ctrl)
    return np.asarray(rb.applied_forces(MODEL, state, ctrl) - with_gear)


def test_it_takes_a_share_of_the_motors_torque_against_the_motion():
    """mu |gear u| tanh(v / v_0), whatever dampers do; forward and backward."""
    gear = rb.forces.GearLoss.of(MODEL, ["a", "b"], jnp.array([0.1, 0.2]), smoothing=0.5)
    for v, u in (([1.0, -0.2], [2.0, -1.0]), ([-0.3, 0.7], [2.0, -1.0]), ([0.0, 0.0], [1.0, 1.0])):
        share = np.array([0.1, 0.2]) * np.abs([3 * u[0], u[1]])
        want = share * np.tanh(np.array(v) / 0.5)
        np.testing.assert_allclose(lost(gear, v, jnp.array(u)), want, rtol=1e-6, atol=1e-6)


def test_without_controls_or_motor_there_is_no_loss():
    gear = rb.forces.GearLoss.of(MODEL, ["b"], 0.2)
    assert not lost(gear, [1.0, 1.0], None).any()
    assert not lost(gear, [1.0, 1.0], jnp.array([5.0, 0.0])).any()
    with pytest.raises(InputError, match="loss has shape"):
        rb.forces.GearLoss.of(MODEL, ["b"], jnp.ones(3))


def test_inverse_dynamics_of_the_motion_is_the_column_of_the_regressor():
    """The torque that moves the arm so, gears included: motors = Y pi with the same mu and v_0."""
    gear = rb.forces.GearLoss.of(MODEL, ["a", "b"], jnp.array([0.1, 0.2]), smoothing=0.5)
    v, u = jnp.array([1.0, -0.4]), jnp.array([2.0, -1.0])
    q, motors = jnp.array([0.3, -0.5]), u * jnp.array([3.0, 1.0])
    state = rb.State(q, v)
    a = rb.forward_dynamics(
        MODEL, q, v, rb.applied_forces(MODEL.with_forces(gear), state, u)
    )  # fmt: skip
    terms = ["armature", "viscous", "gear_loss"]
    pi = np.array(sysid.torque.parameter_values(MODEL, terms))
    pi[-2:] = [0.1, 0.2]
    Y = sysid.torque.regressor(MODEL, q, v, a, joint_terms=terms, smoothing=0.5, tau=motors)
    np.testing.assert_allclose(Y @ pi, motors, rtol=2e-5)
    with pytest.raises(InputError, match="gear_loss"):
        sysid.torque.regressor(MODEL, q, v, a, joint_terms=terms)


KINDS = {
    "affine": "",
    "filtered": 'dyntype="filter" dynprm="0.1"',
    "limited": 'forcelimited="true" forcerange="-0.4 0.4"',
}


@pytest.mark.parametrize("limited", [False, True])
@pytest.mark.parametrize("kind", KINDS)
def test_it_takes_the_forces_of_all_kinds_of_actuators_within_the_limits(kind, limited):
    """A force of 2 (x = 1 or u = 1, gear 2), or 0.8 where the actuator is limited, or 0.3 where
    the joint is."""
    text = ARM.replace(
        '<joint name="b"',
        '<joint name="b" ' + limited * ('actuatorfrclimited="true" actuatorfrcrange="-0.3 0.3" '),
    ).replace('<motor name="b" joint="b"/>', f'<general joint="b" gear="2" {KINDS[kind]}/>')
    model = rb.load(text)
    acting = model.with_forces(rb.forces.GearLoss.of(model, ["b"], 0.5, smoothing=1e-3))
    for dtype in (jnp.float32, jnp.float64):
        v = jnp.ones(2, dtype)
        state = rb.State(0 * v, v, jnp.ones(model.nx, dtype) if model.nx else None)
        u = jnp.array([0.0, 1.0], dtype)
        lost = rb.applied_forces(model, state, u) - rb.applied_forces(acting, state, u)
        force = 0.3 if limited else 0.8 if kind == "limited" else 2.0
        np.testing.assert_allclose(lost, [0.0, 0.5 * force], rtol=1e-6, atol=1e-6)
        assert lost.dtype == dtype
