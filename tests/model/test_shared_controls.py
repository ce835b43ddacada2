"""Elements of actuators that act on a model in addition to the actuators of its file."""

import warnings

import jax.numpy as jnp
import pytest

import rbjax as rb

BODY = '<worldbody><body><joint name="j"/><geom size=".1"/></body></worldbody>'
GENERAL = f'<mujoco>{BODY}<actuator><general name="g" joint="j" %s/></actuator></mujoco>'


@pytest.mark.parametrize("dtype", [jnp.float32, jnp.float64])
def test_an_actuator_on_the_control_of_one_of_the_file_is_said(dtype):
    slow = rb.load(GENERAL % 'dyntype="filter" dynprm="0.1"').astype(dtype)
    fast = rb.load(GENERAL % "").astype(dtype)
    (element,) = slow.forces
    with pytest.warns(UserWarning, match=r"reads the controls of the actuators \['g'\]"):
        both = fast.with_forces(element)
    assert both.nx == 1
    silent = fast.replace(actuators=slow.actuators)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert silent.with_forces(element).nx == 1
        fast.with_forces(rb.forces.JointFriction.of(fast, ("j",), coulomb=0.1))
