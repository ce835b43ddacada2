"""Wrenches at sites, carried down the limbs (few joints) or by world axes, against MuJoCo."""

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
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
    m = mujoco.MjModel.from_xml_string(LIMB)
    model = rb.load(m).replace(driver=driver)
    state, ctrl = model.random_state(jax.random.key(0)), np.array([0.7])
    data = mujoco.MjData(m)
    data.qpos[:], data.qvel[:], data.ctrl[:] = state.q, state.v, ctrl
    mujoco.mj_forward(m, data)
    f = jax.jit(lambda state: rb.applied_forces(model, state, ctrl))
    found = f(state) if closed else jax.jit(rb.applied_forces)(model, state, ctrl)
    assert relative_error(found, data.qfrc_actuator) < F64_PARITY
