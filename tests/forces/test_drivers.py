"""All elements together on a robot with two equal arms, on all three drivers."""

import jax.numpy as jnp
import mujoco
import numpy as np

import rbjax as rb
from rbjax.model import partition
from tests.forces.against_mujoco import DRIVERS, applied, states
from tests.robots import load_quietly
from tests.tolerances import F64_TRANSFORM, relative_error

ARM = """
<body name="{side}" pos="0 {y} 0" gravcomp="0.5">
  <joint name="{side} shoulder" axis="0 1 0" range="-0.2 0.3" frictionloss="0.4"
    stiffness="1 2 3" damping="0.1 0.2 0.3"/><geom pos="0.1 0 0"/>
  <body pos="0.2 0 0"><joint name="{side} elbow" axis="0 1 0" actuatorgravcomp="true"/>
    <geom pos="0.1 0 0"/><site name="{side} hand" pos="0.2 0 0.1"/></body></body>
"""
TWO_ARMED = f"""
<mujoco><compiler angle="radian"/><default><geom contype="0" conaffinity="0" size="0.1"/></default>
<worldbody><body name="trunk"><freejoint/><geom/>
{ARM.format(side="left", y=0.2)}{ARM.format(side="right", y=-0.2)}</body></worldbody>
<tendon><spatial stiffness="9 3" damping="1" springlength="0.1 0.2">
  <site site="left hand"/><site site="right hand"/></spatial></tendon>
<actuator><motor joint="left elbow"/></actuator></mujoco>
"""


def test_all_elements_on_all_drivers() -> None:
    m = mujoco.MjModel.from_xml_string(TWO_ARMED)
    A, model = rb.forces.Place, load_quietly(m, limits=True, friction=True)
    assert model.dropped == () and partition(model.topology).groups
    assert {type(element).__name__ for element in model.forces} == {
        "GravityCompensation", "JointFriction", "JointLimits", "JointPolynomials",
    }  # fmt: skip
    assert model.tendons is not None
    ends = (A.on(body="trunk"), A.on(site="left hand", point=jnp.array([0.1, 0, 0])))
    model = model.with_forces(rb.forces.Bushing.of(*ends, stiffness=3.0, damping=1.0))
    given = states(m, 10)
    want, *found = (applied(model.replace(driver=driver))(*given) for driver in DRIVERS)
    assert np.abs(want).max(0).min() > 0
    for other in found:
        assert relative_error(other, want, batch_dims=1).max() < F64_TRANSFORM
