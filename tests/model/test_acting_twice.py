"""Force elements that act in addition to the actuators or to the contact law of a model."""

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


BALLS = """<mujoco><worldbody><body><freejoint/><geom type="box" size="0.1 0.1 0.1"/></body>
  <body pos="0 0 0.2"><freejoint/><geom size="0.1"/></body></worldbody></mujoco>"""


def test_compliant_contact_beside_a_contact_law_is_said() -> None:
    model = rb.load(BALLS)
    assert model.geoms.pairs == ((1, 0),)
    for pair in ((1, 0), (0, 1)):
        contact = rb.contact.CompliantContact.of(
            model.replace(contact=None), stiffness=1e4, pairs=[pair]
        )
        with pytest.warns(UserWarning, match="in addition to the contact law 'mujoco'"):
            model.with_forces(contact)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            model.replace(contact=None).with_forces(contact)
