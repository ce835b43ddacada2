"""Actuators against MuJoCo: wrenches at sites, carried down the limbs (few joints) or by world
axes; rows of what comes after an actuator of several controls; what the file switches off."""

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.robots import load_quietly
from tests.tolerances import F64_PARITY, relative_error

# a site on a body that is welded to the second link, behind a ball and a slide
LIMB = """
<mujoco><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body><joint type="ball"/><geom size="0.1" pos="0.1 0 0"/>
  <body pos="0.2 0.1 0"><joint type="slide" axis="1 1 0"/><geom size="0.1"/>
    <body pos="0 0.1 0.3" euler="20 30 40"><geom size="0.05"/>
      <site name="jet" pos="0.1 0.2 0.3" euler="10 50 -30"/></body>
    <body pos="0 -0.2 0"><joint axis="0 1 1"/><geom size="0.1" pos="0 0 0.1"/></body>
  </body></body></worldbody>
<actuator><general site="jet" gear="1 2 3 0.4 0.5 0.6" gainprm="2"/></actuator></mujoco>
"""


@pytest.mark.parametrize("driver", ["unrolled", "rolled"])
@pytest.mark.parametrize("closed", [True, False], ids=["closed over", "argument"])
def test_a_wrench_at_a_site(driver, closed):
    agrees_with_mujoco(LIMB, np.array([0.7]), driver, closed)


def agrees_with_mujoco(text: str, ctrl: np.ndarray, driver: str = "unrolled", closed: bool = True):
    m = mujoco.MjModel.from_xml_string(text)
    model = load_quietly(m).replace(driver=driver)
    state = model.random_state(jax.random.key(0))
    data = mujoco.MjData(m)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state.q, state.v, ctrl
    mujoco.mj_forward(m, data)
    f = jax.jit(lambda state: rb.applied_forces(model, state, ctrl))
    found = f(state) if closed else jax.jit(rb.applied_forces)(model, state, ctrl)
    assert relative_error(found, data.qfrc_actuator) < F64_PARITY
    return model


@pytest.mark.parametrize("driver", ["unrolled", "rolled"])
@pytest.mark.parametrize("closed", [True, False], ids=["closed over", "argument"])
def test_a_wrench_at_a_site_of_the_world_moves_nothing(driver, closed):
    at_world = LIMB.replace("<worldbody>", '<worldbody><site name="fixed" pos="0 0 1"/>')
    agrees_with_mujoco(at_world.replace('site="jet"', 'site="fixed"'), [0.7], driver, closed)


# a ball and a hinge, with what the actuators are
DRIVEN = """
<mujoco><option {option}/><default><geom contype="0" conaffinity="0"/></default><worldbody>
<body><joint name="b" type="ball"/><geom size="0.1" pos="0.1 0 0"/>
  <body pos="0.2 0.1 0"><joint name="h" axis="1 1 0"/><geom size="0.1" pos="0 0 0.1"/></body>
</body></worldbody><actuator>{actuators}</actuator></mujoco>
"""
MOTORS = """
<motor name="m" joint="h" gear="7" ctrlrange="-1 0.5" forcerange="-3 0.3"/>
<position name="p" joint="h" gear="2" kp="3" kv="0.4" ctrlrange="-0.1 0.2" forcerange="-9 9"/>
"""


@pytest.mark.parametrize(
    ("several", "controls"),
    [
        ('<orientation name="o" joint="b" kp="3"/>', 3),  # three controls, three outputs
        ('<pid name="o" joint="h" kp="3" input="pos vel"/>', 2),  # one output
    ],
    ids=["orientation", "pid"],
)
def test_motors_after_an_actuator_of_several_controls(several, controls):
    text = DRIVEN.format(option="", actuators=several + MOTORS)
    ctrl = np.append(np.full(controls, 0.3), [9.0, 9.0])
    model = agrees_with_mujoco(text, ctrl)
    assert model.actuator_names == (*(f"o[{i}]" for i in range(controls)), "m", "p")
    assert model.dropped == () and len(model.forces) == 1
    np.testing.assert_array_equal(model.actuators.gear[:, 0], [0] * controls + [7, 2])
    np.testing.assert_array_equal(model.actuators.ctrlrange[-2:], [[-1, 0.5], [-0.1, 0.2]])
    np.testing.assert_array_equal(model.actuators.forcerange[-2:], [[-3, 0.3], [-9, 9]])


@pytest.mark.parametrize("option", ['actuatorgroupdisable="1 30"', 'actuatorgroupdisable="0"'])
def test_actuators_of_disabled_groups_give_no_force(option):
    groups = "".join(
        f'<motor name="m{group}" joint="h" gear="{2 + group}" group="{group}"/>'
        for group in (0, 1, 2, 30, 31)
    )
    lag = f'<general name="lag" joint="h" dyntype="filter" group="{option[22]}"/>'
    model = agrees_with_mujoco(DRIVEN.format(option=option, actuators=groups + lag), np.ones(6))
    assert model.nu == 6 and model.dropped == ()  # what is off is not left out
