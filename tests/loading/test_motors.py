"""Motors on joints that no actuator drives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb

TWO = """<robot name="two">
  <link name="base"/>
  {links}
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="3" velocity="1"/></joint>
  <joint name="reach" type="prismatic"><parent link="arm"/><child link="hand"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" effort="9" velocity="1"/></joint>
</robot>""".format(links="".join(
    f'<link name="{name}"><inertial><mass value="1"/>'
    '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
    for name in ("arm", "hand")
))


@pytest.mark.filterwarnings("ignore:.*joint limits")
def test_a_urdf_is_driven():
    model = rb.load(TWO, motors=True)
    assert model.actuator_names == ("shoulder", "reach")
    force = rb.applied_forces(model, model.default_state(), jnp.array([2.0, -20.0]))
    np.testing.assert_array_equal(force, [2.0, -9.0])  # within the joints' effort
    path = rb.rollout(model, model.default_state(), jnp.ones((3, 2)), 0.01)
    assert path.ok


def test_what_is_driven_gets_no_second_motor():
    plain, more = rb.load("cart_pole"), rb.load("cart_pole", motors=True)
    assert more.actuator_names == (*plain.actuator_names, "hinge")
    state = more.random_state(jax.random.key(0))
    force = rb.applied_forces(more, state, jnp.array([0.5, 2.0]))
    want = rb.applied_forces(plain, state, jnp.array([0.5])) + jnp.array([0.0, 2.0])
    np.testing.assert_allclose(force, want)
    assert more.keyframes.ctrl.shape[1] == 2
