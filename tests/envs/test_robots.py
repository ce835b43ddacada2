"""The robots of `rbjax.envs` against the files of MuJoCo Playground, if it is installed."""

import importlib.util
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.envs.suite import walking

FOUND = importlib.util.find_spec("mujoco_playground")
FIELDS = [
    "body_mass",
    "body_ipos",
    "body_iquat",
    "body_inertia",
    "body_pos",
    "body_quat",
    "jnt_axis",
    "jnt_pos",
    "jnt_range",
    "jnt_actfrcrange",
    "dof_armature",
    "dof_damping",
    "dof_frictionloss",
    "actuator_gainprm",
    "actuator_biasprm",
    "actuator_forcerange",
    "actuator_ctrlrange",
    "site_pos",
    "site_quat",
    "dof_invweight0",
    "body_invweight0",
]


def original(name: str) -> mujoco.MjModel:
    """The file of Playground with its flat floor, without meshes, which have no mass."""
    folder = Path(FOUND.origin).parent / "_src" / "locomotion" / name / "xmls"
    root = ElementTree.parse(folder / f"{name}_mjx_feetonly.xml").getroot()
    for parent in list(root.iter()):
        for x in list(parent):
            if x.tag == "mesh" or (x.tag == "geom" and x.get("mesh")):
                parent.remove(x)
            elif x.tag == "geom" and x.get("type") == "mesh":
                del x.attrib["type"]
    scene = ElementTree.parse(folder / "scene_mjx_feetonly_flat_terrain.xml").getroot()
    floor = scene.find(".//geom[@name='floor']")
    del floor.attrib["material"]
    root.find("worldbody").insert(0, floor)
    root.append(scene.find("keyframe"))
    model = mujoco.MjModel.from_xml_string(ElementTree.tostring(root, encoding="unicode"))
    model.opt.tolerance, model.opt.iterations, model.opt.ls_iterations = 0.0, 200, 100
    model.opt.ls_tolerance = 1e-10
    return model


@pytest.mark.skipif(FOUND is None, reason="needs the package playground")
@pytest.mark.parametrize("name", ["go1", "g1"])
def test_the_robot_is_the_one_of_playground(name):
    theirs, ours = original(name), walking.compiled(name)
    sites = [ours.site(i).name for i in range(ours.nsite)]
    for field in FIELDS:
        due = getattr(theirs, field)
        if field.startswith("site"):
            due = due[[theirs.site(site).id for site in sites]]
        np.testing.assert_array_equal(getattr(ours, field), due, err_msg=field)
    np.testing.assert_array_equal(ours.key_qpos[0], theirs.key(ours.key(0).name).qpos)
    rng, model = np.random.default_rng(0), rb.load(str(walking.path(name)))
    for _ in range(20):
        q = theirs.key(ours.key(0).name).qpos + 0.05 * rng.normal(size=ours.nq)
        q[3:7] /= np.linalg.norm(q[3:7])
        v, ctrl = rng.normal(size=ours.nv), q[7:] + 0.3 * rng.normal(size=ours.nu)
        ctrl = np.clip(ctrl, *ours.actuator_ctrlrange.T)
        one = walking.Robot(theirs, q, v, ctrl)
        M = np.zeros((ours.nv, ours.nv))
        mujoco.mj_fullM(theirs, one.data, M) if _new() else mujoco.mj_fullM(theirs, M, one.data.qM)
        np.testing.assert_allclose(rb.mass_matrix(model, q), M, atol=1e-12)
        # mj_rne without accelerations
        np.testing.assert_allclose(rb.bias_forces(model, q, v), one.data.qfrc_bias, atol=1e-10)
        state = rb.State(np.asarray(q), np.asarray(v))
        after, due = rb.step(model, state, ctrl), one.steps(1).data
        np.testing.assert_allclose(after.q, due.qpos, atol=1e-11)
        np.testing.assert_allclose(after.v, due.qvel, atol=1e-9)


def _new() -> bool:
    return int(mujoco.__version__.split(".")[0]) >= 4


def test_masses_of_the_data_sheets():
    # Unitree: Go1 12 kg with battery, G1 about 35 kg
    assert np.isclose(walking.compiled("go1").body_mass.sum(), 12.743, atol=1e-3)
    assert np.isclose(walking.compiled("g1").body_mass.sum(), 33.341, atol=1e-3)


@pytest.mark.parametrize("name", ["go1", "g1"])
def test_nothing_is_left_out(name):
    model = rb.load(str(walking.path(name)), strict=True)
    assert model.dropped == () and model.contact == "mujoco"
