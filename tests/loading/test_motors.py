"""Motors on joints that no actuator drives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rbjax as rb
from tests.robots import load_quietly

TWO = """<robot name="two">
  <link name="base"/>
  {links}
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="3" velocity="1"/></joint>
  <joint name="reach" type="prismatic"><parent link="arm"/><child link="hand"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="1" effort="9" velocity="1"/></joint>
</robot>""".format(
    links="".join(
        f'<link name="{name}"><inertial><mass value="1"/>'
        '<inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>'
        for name in ("arm", "hand")
    )
)


@pytest.mark.filterwarnings("ignore:.*joint limits")
def test_a_urdf_is_driven():
    model = rb.load(TWO, motors=True)
    assert model.actuator_names == ("shoulder", "reach")
    force = rb.applied_forces(model, model.default_state(), jnp.array([2.0, -20.0]))
    np.testing.assert_array_equal(force, [2.0, -9.0])  # within the joints' effort
    path = rb.rollout(model, model.default_state(), jnp.ones((3, 2)), 0.01)
    assert path.success


def test_what_is_driven_gets_no_second_motor():
    plain, more = rb.load("cart_pole"), rb.load("cart_pole", motors=True)
    assert more.actuator_names == (*plain.actuator_names, "hinge")
    state = more.random_state(jax.random.key(0))
    force = rb.applied_forces(more, state, jnp.array([0.5, 2.0]))
    want = rb.applied_forces(plain, state, jnp.array([0.5])) + jnp.array([0.0, 2.0])
    np.testing.assert_allclose(force, want)
    assert more.keyframes.ctrl.shape[1] == 2


ONE = '<body><joint name="{0}"/><geom size=".1"/>{1}</body>'
DRIVES = {
    "filtered": '<general joint="j" dyntype="filter" dynprm="0.1"/>',
    "muscle": '<muscle joint="j" lengthrange="-1 1"/>',
    "servo": '<intvelocity joint="j" kp="1" actrange="-1 1"/>',
    "tendon": '<motor tendon="t"/>',
    "motor": '<motor joint="j"/>',
}


@pytest.mark.parametrize("drive", DRIVES)
def test_a_joint_that_any_actuator_drives_gets_no_second_motor(drive):
    text = (
        f"<mujoco><worldbody>{ONE.format('j', ONE.format('k', ''))}</worldbody><tendon>"
        '<fixed name="t"><joint joint="j" coef="1"/></fixed></tendon>'
        f"<actuator>{DRIVES[drive]}</actuator></mujoco>"
    )
    plain = load_quietly(text)
    assert load_quietly(text, motors=True).actuator_names == (*plain.actuator_names, "k")


def test_followers_get_none_and_names_stay_unique():
    follows = TWO.replace('type="prismatic">', 'type="prismatic"><mimic joint="shoulder"/>')
    assert load_quietly(follows, motors=True).actuator_names == ("shoulder",)
    apart = load_quietly(follows, motors=True, constraints=False)
    assert apart.actuator_names == ("shoulder", "reach")
    taken = (
        f"<mujoco><worldbody>{ONE.format('j', ONE.format('k', ''))}</worldbody>"
        '<actuator><motor name="k" joint="j"/></actuator></mujoco>'
    )
    assert load_quietly(taken, motors=True).actuator_names == ("k", "k_motor")
