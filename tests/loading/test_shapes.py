"""Shapes about an axle: closed forms; what MuJoCo can read of a URDF's; the file at rest."""

import mujoco
import numpy as np
import pytest

from rbjax.errors import InputError, UnknownName
from rbjax.loading.at_rest import at_rest, round_shape
from rbjax.loading.sources import compile_model
from rbjax.loading.urdf.shapes import find_mesh

AXLE = np.array([0.0, 1.0, 0.0])
LYING = 'euler="90 0 0"'
CASES = {
    # geoms, the farthest point from y through the origin, the middle of its rim along y
    "cylinder": (f'<geom type="cylinder" size="0.3 0.1" pos="0 0.2 0" {LYING}/>', 0.3, 0.2),
    "cylinder of a file with 1.57": (
        '<geom type="cylinder" size="0.3 0.1" euler="89.96 0 0"/>', 0.3, 0.0),
    "standing cylinder": ('<geom type="cylinder" size="0.3 0.4"/>', 0.5, 0.0),
    "sphere off the axle": ('<geom size="0.3" pos="0 0.1 0.2"/>', 0.5, 0.1),
    "capsule": (f'<geom type="capsule" size="0.2 0.1" {LYING}/>', 0.2, 0.0),
    "standing capsule": ('<geom type="capsule" size="0.2 0.1"/>', 0.3, 0.0),
    "ellipsoid": ('<geom type="ellipsoid" size="0.3 0.1 0.3"/>', 0.3, 0.0),
    "box": ('<geom type="box" size="0.3 0.1 0.4"/>', 0.5, 0.0),
    "tyre and hub": (
        f'<geom type="cylinder" size="0.3 0.1" {LYING}/><geom size="0.25" pos="0 0.5 0"/>',
        0.3, 0.0),
    "two tyres": (
        f'<geom type="cylinder" size="0.3 0.1" {LYING}/>'
        f'<geom type="cylinder" size="0.3 0.1" pos="0 0.6 0" {LYING}/>', 0.3, 0.3),
    "a larger one that is only seen": (
        '<geom size="0.3"/><geom size="0.5" contype="0" conaffinity="0"/>', 0.3, 0.0),
    "only seen": ('<geom size="0.5" contype="0" conaffinity="0"/>', 0.5, 0.0),
}  # fmt: skip

#: the relative error of a corner between two of the directions that are sampled, at most
EXACT = dict.fromkeys(["box", "standing cylinder"], (np.pi / 360) ** 2 / 2)


@pytest.mark.parametrize("name", CASES)
def test_extents_have_closed_forms(name: str) -> None:
    geoms, radius, middle = CASES[name]
    m = compile_model(f"<mujoco><worldbody><body>{geoms}</body></worldbody></mujoco>")
    found = round_shape(m, {1: (np.zeros(3), np.eye(3))}, np.zeros(3), AXLE)
    assert found is not None
    np.testing.assert_allclose(found.radius, radius, rtol=EXACT.get(name, 1e-12))
    np.testing.assert_allclose(found.centre, [0.0, middle, 0.0], atol=1e-12)


def test_a_mesh_reaches_as_far_as_its_vertices() -> None:
    mesh = '<mesh name="a" vertex="0.3 0 0  0 0 0.2  -0.1 0.4 0  0 -0.1 -0.25"/>'
    body = '<body pos="1 2 3" euler="0 0 90"><geom type="mesh" mesh="a"/></body>'
    m = compile_model(f"<mujoco><asset>{mesh}</asset><worldbody>{body}</worldbody></mujoco>")
    d = mujoco.MjData(m)
    mujoco.mj_kinematics(m, d)
    turn = d.xmat[1].reshape(3, 3)
    found = round_shape(m, {1: (d.xpos[1], turn)}, d.xpos[1], turn[:, 1])
    assert found is not None
    np.testing.assert_allclose(found.radius, 0.3, rtol=1e-6)  # meshes are f32
    np.testing.assert_allclose(found.centre, d.xpos[1], atol=1e-6)


def test_a_plane_is_no_wheel() -> None:
    m = compile_model('<mujoco><worldbody><geom type="plane" size="1 1 1"/></worldbody></mujoco>')
    assert round_shape(m, {0: (np.zeros(3), np.eye(3))}, np.zeros(3), AXLE) is None


def test_meshes_are_found_beside_the_file_and_in_its_package(tmp_path) -> None:
    package = tmp_path / "my_robot"
    (package / "urdf").mkdir(parents=True)
    (package / "meshes").mkdir()
    wheel = package / "meshes" / "a wheel.stl"
    wheel.write_text("solid")
    here = package / "urdf"
    for name in (
        "package://my_robot/meshes/a%20wheel.stl", "../meshes/a wheel.stl", f"file://{wheel}",
    ):  # fmt: skip
        found = find_mesh(name, here)
        assert found is not None and found.resolve() == wheel.resolve()
    assert find_mesh("package://other/meshes/a wheel.stl", here) is None
    assert find_mesh("../meshes/a wheel.dae", here) is None
    # a package in a folder beside those above the file
    assert find_mesh("package://my_robot/meshes/a wheel.stl", tmp_path) == wheel


def test_a_file_at_rest_is_mujocos() -> None:
    rest = at_rest("cart_pole", {"slider": 0.3, "hinge": 0.7})
    m = rest.m
    data = mujoco.MjData(m)
    data.qpos[:] = rest.d.qpos
    mujoco.mj_forward(m, data)
    bodies = range(1, m.nbody)
    whole = rest.composite(bodies)
    np.testing.assert_allclose(whole.mass, m.body_mass.sum(), rtol=1e-14)
    np.testing.assert_allclose(whole.com, data.subtree_com[0], atol=1e-14)
    last = m.njnt - 1
    assert rest.chain(int(m.jnt_bodyid[last]))[-1] == last
    assert set(rest.above(last)) == set(range(last))
    M = np.zeros((m.nv, m.nv))
    mujoco.mj_fullM(m, data, M)
    about = rest.composite(rest.behind(last)).about(rest.axis(last), rest.anchor(last))
    np.testing.assert_allclose(about + rest.armature(last), M[last, last], rtol=1e-12)
    np.testing.assert_allclose(rest.damping(last), 0.001)


def test_bad_configurations_are_refused() -> None:
    with pytest.raises(UnknownName, match="keyframe 'home'"):
        at_rest("cart_pole", "home")
    with pytest.raises(UnknownName, match="joint 'nose'"):
        at_rest("cart_pole", {"nose": 1.0})
    with pytest.raises(InputError, match="2 finite numbers"):
        at_rest("cart_pole", [0.0, np.inf])
    with pytest.raises(UnknownName, match="body or site 'nose'"):
        at_rest("cart_pole").frame("nose")
