"""What forces say to an implicit step: the slopes h D / 2 + h^2 K / 4 of springs and servos."""

import jax.numpy as jnp
import numpy as np

import rbjax as rb
from rbjax.forces.acting import slopes
from rbjax.motion.variational import implicit_stiffness

# a sprung hinge, two with actuators, and one without anything
ROBOT = """
<mujoco><default><geom contype="0" conaffinity="0" size="0.1"/></default><worldbody>
<body><joint name="sprung" damping="0.3" stiffness="2"/><geom/>
  <body><joint name="servo"/><geom/>
    <body><joint name="pushed"/><geom/>
      <body><joint name="bare"/><geom/></body></body></body></body>
</worldbody><actuator>
<position joint="servo" kp="5" kv="0.7" gear="2" forcerange="-4 4"/>
<general joint="pushed" biastype="affine" biasprm="0 3 0"/>
</actuator></mujoco>
"""


def test_slopes_of_a_step() -> None:
    """In closed form: a gear counts twice, a slope that drives away and one at its limit not."""
    model, h = rb.load(ROBOT), 0.1
    spring, servo = h / 2 * 0.3 + h * h / 4 * 2, 4 * (h / 2 * 0.7 + h * h / 4 * 5)
    for ctrl, want in (
        (None, {0: spring}),
        (jnp.array([0.5, 0.0]), {0: spring, 1: servo, 2: 0.0}),
        (jnp.array([9.0, 0.0]), {0: spring, 1: 0.0, 2: 0.0}),
    ):
        found = implicit_stiffness(
            model.topology, slopes(model, 0.0, model.default_state(), ctrl), h
        )
        assert found.keys() == want.keys()
        np.testing.assert_allclose(list(found.values()), list(want.values()), rtol=1e-12)
