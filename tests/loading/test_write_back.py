"""A model's numbers in the user's own file: read again, it is the found model; the rest stays."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

import rbjax as rb
from rbjax.sysid import Inertia
from rbjax.sysid.parameters import pseudo_inertia_of, to_log_cholesky
from rbjax.sysid.parameters.log_cholesky import log_cholesky_parameters

MJCF = """
<mujoco model="mine">
 <default><joint damping="0.5" armature="0.02"/><default class="blue"><geom rgba="0 0 1 1"/>
 </default></default>
 <worldbody><light pos="0 0 3"/>
  <body name="arm"><joint name="shoulder" axis="0 1 0" frictionloss="0.1"/>
   <geom class="blue" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.03"/>
   <body name="hand" pos="0 0 -0.4"><joint name="wrist" axis="1 0 0" damping="0.1"/>
    <inertial pos="0 0 -0.1" mass="0.4" diaginertia="1e-3 1e-3 5e-4"/>
    <site name="grip" pos="0 0 -0.2"/></body></body></worldbody>
 <actuator><position name="servo" joint="shoulder" kp="30"/><motor name="m" joint="wrist" gear="3"/>
 </actuator>
 <sensor><jointpos joint="wrist"/></sensor></mujoco>
"""
URDF = """<robot name="mine"><!-- by hand -->
 <link name="base"/>
 <link name="arm"><inertial><origin xyz="0 0 -0.2" rpy="0.3 0 0"/><mass value="1.5"/>
  <inertia ixx="0.02" ixy="0" ixz="0" iyy="0.02" iyz="0" izz="0.002"/></inertial>
  <visual><geometry><box size="0.1 0.1 0.4"/></geometry></visual></link>
 <link name="hand"><inertial><origin xyz="0 0.1 0"/><mass value="0.4"/>
  <inertia ixx="0.002" ixy="0" ixz="0" iyy="0.001" iyz="0" izz="0.002"/></inertial></link>
 <joint name="shoulder" type="revolute"><parent link="base"/><child link="arm"/><axis xyz="0 1 0"/>
  <limit lower="-2" upper="2" effort="30" velocity="3"/><dynamics damping="0.2" friction="0.1"/>
 </joint>
 <joint name="wrist" type="continuous"><parent link="arm"/><child link="hand"/>
  <origin xyz="0 0 -0.4" rpy="0 0.2 0"/><axis xyz="1 0 0"/></joint></robot>
"""


def changed(model, armature=True):
    """Other inertias, with products of inertia, and other numbers of joints and actuators."""
    for k, name in enumerate(model.body_names[-2:]):
        theta = to_log_cholesky(pseudo_inertia_of(Inertia(name).read(model)))
        theta = theta + 0.1 * np.random.default_rng(k).normal(size=10)
        model = Inertia(name).write(model, log_cholesky_parameters(theta))
    joints = model.joints.replace(damping=model.joints.damping + jnp.array([0.25, 0.05]))
    if armature:
        joints = joints.replace(armature=jnp.array([0.03, 0.011]))
    return model.replace(joints=joints)


def same(model, again):
    """Accelerations of both to 1e-9."""
    rng = np.random.default_rng(0)
    q, v = rng.normal(size=(2, model.nq))
    run = jax.jit(lambda m: rb.forward_dynamics(m, jnp.asarray(q), jnp.asarray(v), jnp.zeros(2)))
    np.testing.assert_allclose(run(again), run(model), rtol=1e-9)
    u = jnp.asarray(rng.normal(size=model.nu))
    state = rb.State(jnp.asarray(q), jnp.asarray(v))
    of = jax.jit(lambda m: rb.applied_forces(m, state, u))
    np.testing.assert_allclose(of(again), of(model), rtol=1e-9, atol=1e-12)


@pytest.mark.filterwarnings("ignore:.*left out of the model")
def test_mjcf_keeps_all_but_the_numbers(tmp_path):
    source = tmp_path / "mine.xml"
    source.write_text(MJCF)
    model = changed(rb.load(source, friction=True))
    gains = model.actuators.replace(
        gain=model.actuators.gain.at[0, 0].set(42.0), bias=model.actuators.bias.at[0, 1].set(-42.0)
    )
    dry = model.forces[0].replace(coulomb=jnp.array([0.17]))
    model = model.replace(actuators=gains, forces=(dry, *model.forces[1:]))
    out = rb.write_back(model, source, tmp_path / "found.xml")
    same(model, rb.load(tmp_path / "found.xml", friction=True))
    for kept in ("capsule", "light", "jointpos", "grip", "class", 'gear="3'):
        assert kept in out
    assert [p.name for p in tmp_path.iterdir() if p.name.startswith(".")] == []


@pytest.mark.filterwarnings("ignore:.*left out of the model")
def test_urdf_keeps_all_but_the_numbers(tmp_path):
    source = tmp_path / "mine.urdf"
    source.write_text(URDF)
    model = changed(rb.load(source, friction=True), armature=False)
    out = rb.write_back(model, source, tmp_path / "found.urdf")
    same(model, rb.load(tmp_path / "found.urdf", friction=True))
    for kept in ("<!-- by hand -->", '<box size="0.1 0.1 0.4" />', 'effort="30"', 'friction="0.1"'):
        assert kept in out
    untouched = rb.write_back(rb.load(source), source)
    assert 'rpy="0.3 0 0"' in untouched  # a link that did not change stays as it was


@pytest.mark.filterwarnings("ignore:.*left out of the model")
def test_what_a_file_cannot_say_is_named():
    model = rb.load(URDF)
    armed = model.replace(joints=model.joints.replace(armature=jnp.ones(2)))
    with pytest.raises(rb.ModelError, match=r"joints.armature; a URDF has no armature"):
        rb.write_back(armed, URDF)
    with pytest.raises(rb.InputError, match="body_names"):
        rb.write_back(rb.load("pendulum"), URDF)


def test_nothing_is_written_beside_the_file(tmp_path, monkeypatch) -> None:
    """Its meshes are found all the same."""
    corners = "0 0 0  0.1 0 0  0 0.1 0  0 0 0.1"
    faces = "0 2 1  0 1 3  0 3 2  1 2 3"
    lines = [f"v {x}" for x in corners.split("  ")]
    lines += ["f " + " ".join(str(int(k) + 1) for k in face.split()) for face in faces.split("  ")]
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "t.obj").write_text("\n".join(lines))
    (tmp_path / "robot.xml").write_text(
        '<mujoco><compiler meshdir="meshes"/><asset><mesh name="t" file="t.obj"/></asset>'
        '<worldbody><body name="b"><joint name="j"/><geom type="mesh" mesh="t"/></body>'
        "</worldbody></mujoco>"
    )
    model = rb.load(tmp_path / "robot.xml")
    heavy = model.replace(bodies=model.bodies.replace(mass=2 * model.bodies.mass))
    monkeypatch.setattr(type(tmp_path), "write_text", None)  # a folder that cannot be written to
    out = rb.write_back(heavy, tmp_path / "robot.xml")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["meshes", "robot.xml"]
    assert f"{float(heavy.bodies.mass[0]):.8g}"[:6] in out


@pytest.mark.filterwarnings("ignore:.*left out of the model")
def test_friction_of_a_joint_after_one_of_several_dofs(tmp_path) -> None:
    """Friction losses are written by dof: the hinge after a ball keeps its own, and two elements
    on it add up."""
    source = tmp_path / "ball.xml"
    source.write_text(
        "<mujoco><worldbody><body><joint name='ball' type='ball'/><geom size='.1'/>"
        "<body pos='0 0 .3'><joint name='hinge' axis='0 1 0' frictionloss='.4'/>"
        "<geom size='.1'/></body></body></worldbody></mujoco>"
    )
    model = rb.load(source)
    one = rb.forces.JointFriction.of(model, ["ball", "hinge"], [0.1, 0.1, 0.1, 0.2])
    two = rb.forces.JointFriction.of(model, ["hinge"], 0.5)
    rb.write_back(model.with_forces(one, two), source, tmp_path / "found.xml")
    found = mujoco.MjModel.from_xml_path(str(tmp_path / "found.xml"))
    np.testing.assert_allclose(found.dof_frictionloss[3], 0.7)
