"""A URDF's own inertials: those that MuJoCo refuses count as Pinocchio counts them."""

import importlib.metadata
import warnings
from pathlib import Path

import jax
import mujoco
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.models import REFUSED
from rbjax.loading import compile_model
from tests.loading.test_load import joint, urdf
from tests.oracles.pinocchio_urdf import Peer
from tests.tolerances import F64_PARITY, F64_ROUNDING, relative_error

Array = np.ndarray
MOMENTS = (0.3, 0.25, 0.2, 0.01, -0.02, 0.03)  # xx yy zz xy xz yz


def link(name: str, mass: object = 1.5, moments: tuple = MOMENTS, rpy: str = "0.5 -0.4 1") -> str:
    keys, moments = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"), (*moments, 0, 0, 0)[:6]
    inertia = " ".join(f'{key}="{x}"' for key, x in zip(keys, moments, strict=True))
    return (
        f'<link name="{name}"><inertial><origin xyz="0.1 -0.2 0.3" rpy="{rpy}"/>'
        f'<mass value="{mass}"/><inertia {inertia}/></inertial></link>'
    )


def chain(middle: str, kind: str = "continuous") -> str:
    """base - turn - middle - slide - hand, and a frame welded to the hand."""
    return urdf(
        link("base"), middle, link("hand", 0.8), '<link name="frame"/>',
        joint("turn", "base", "middle", kind), joint("slide", "middle", "hand", "prismatic"),
        joint("weld", "hand", "frame", "fixed"),
    )  # fmt: skip


def error_beside_pinocchio(source, *, floating_base: bool = False, states: int = 3) -> float:
    """The largest relative error of mass matrix, bias forces and accelerations."""
    pytest.importorskip("pinocchio", reason="pin is not installed")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = rb.load(source, floating_base=floating_base).replace(driver="rolled")
    peer = Peer(source, model, floating_base=floating_base)

    def ours(q, v, tau):
        bias, a = rb.bias_forces(model, q, v), rb.forward_dynamics(model, q, v, tau)
        return rb.mass_matrix(model, q), bias, a

    ours = jax.jit(ours)
    rng, worst, free = np.random.default_rng(0), 0.0, "free" in model.topology.joint_kinds
    for _ in range(states):
        q = rng.normal(size=model.nq)
        if free:
            q[3:7] /= np.linalg.norm(q[3:7])
        v, tau = rng.normal(size=(2, model.nv))
        there = peer.mass_matrix(q), peer.bias_forces(q, v), peer.forward_dynamics(q, v, tau)
        errors = [relative_error(a, b) for a, b in zip(ours(q, v, tau), there, strict=True)]
        worst = max(worst, *errors, key=lambda x: np.inf if np.isnan(x) else x)
    return float(worst)


ODD = {  # of the middle link: its XML, what is said of it
    "triangle": (link("middle", 1, (0.1, 0.1, 0.5)), "above the sum of the other two"),
    "negative moment": (link("middle", 1, (0.1, -0.05, 0.1)), "below zero"),
    "point": (link("middle", 1, (0, 0, 0)), "mass without inertia"),
    "inertia without mass": (link("middle", 0), "inertia without mass"),
    "negative mass": (link("middle", -0.1), "negative mass"),
    "tiny": (link("middle", 1e-9, (1e-20, 1e-20, 1e-20)), ""),
    "zeros": (link("middle", 0, (0, 0, 0)), ""),
    "no inertia": ('<link name="middle"><inertial><mass value="2"/></inertial></link>', "without"),
    "no inertial": ('<link name="middle"/>', ""),
    "well": (link("middle"), ""),
}


# Pinocchio divides by a floor of the mass where it is negative, and drops what is incomplete
NOT_THERE = {"negative mass", "no inertia"}


@pytest.mark.parametrize("case", [case for case in ODD if case not in NOT_THERE])
def test_any_inertial_counts_as_it_does_for_pinocchio(case: str) -> None:
    assert error_beside_pinocchio(chain(ODD[case][0])) <= F64_PARITY


def test_of_a_floating_base_too() -> None:
    worst = link("middle", 1, (0.1, 0.1, 0.5))
    assert error_beside_pinocchio(chain(worst), floating_base=True) <= F64_PARITY


@pytest.mark.parametrize("case", ODD)
def test_links_that_no_rigid_body_has_are_named(case: str) -> None:
    text, words = chain(ODD[case][0]), ODD[case][1]
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        model = rb.load(text)
    said = [str(w.message) for w in caught if "no rigid body" in str(w.message)]
    assert len(said) == bool(words)
    for message in said:
        assert words in message and message.count("middle") == 1 and "expected" in message
        assert "hand" not in message and "correct the file" in message
    assert not any("no rigid body" in entry for entry in model.dropped)  # nothing was left out


def test_the_warning_points_at_the_caller() -> None:
    with pytest.warns(UserWarning, match="no rigid body") as caught:
        text = chain(ODD["triangle"][0], kind="continuous").replace("prismatic", "continuous")
        rb.load(text, floating_base=False)
    assert [w.filename for w in caught] == [__file__]


def test_an_odd_link_that_cannot_move_is_not_mentioned() -> None:
    text = urdf(link("base", 1, (1, 1, 9)), link("arm"), joint("j", "base", "arm", "continuous"))
    assert rb.load(text, floating_base=False).nv == 1  # a warning would fail the test


def test_numbers_are_those_of_the_file() -> None:
    text = chain(link("middle", 0.7, (0.1, 0.2, 0.9), rpy="0 0 0")).replace("prismatic", "revolute")
    with pytest.warns(UserWarning):
        model = rb.load(text)
    i = model.body("middle")
    assert float(model.bodies.mass[i]) == 0.7
    np.testing.assert_array_equal(model.bodies.com[i], [0.1, -0.2, 0.3])
    np.testing.assert_array_equal(model.bodies.inertia[i], np.diag([0.1, 0.2, 0.9]))
    xx, yy, zz, xy, xz, yz = MOMENTS
    full = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
    turn = np.empty(9)
    quat = np.empty(4)
    mujoco.mju_euler2Quat(quat, np.array([0.5, -0.4, 1]), "XYZ")
    mujoco.mju_quat2Mat(turn, quat)
    full = turn.reshape(3, 3) @ full @ turn.reshape(3, 3).T
    got = model.bodies.inertia[model.body("hand")]
    np.testing.assert_allclose(got, full, rtol=0, atol=F64_ROUNDING)


def test_settings_of_mujoco_do_not_touch_them() -> None:
    settings = "balanceinertia='true' boundmass='9' boundinertia='9' settotalmass='1'"
    text = chain(link("middle")).replace(
        "<link", f"<mujoco><compiler {settings}/></mujoco><link", 1
    )
    m = compile_model(text)
    np.testing.assert_array_equal(m.body_mass[-3:], [1.5, 0.8, 0.0])


def test_mujoco_computes_with_them_too() -> None:
    """So `rbjax.validation.compare` has two sides that mean one robot."""
    text = chain(ODD["negative moment"][0])
    m = compile_model(text)
    data = mujoco.MjData(m)
    data.qpos, data.qvel = [0.3, -0.2], [1.0, 2.0]
    mujoco.mj_forward(m, data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = rb.load(text)
    assert relative_error(rb.bias_forces(model, data.qpos, data.qvel), data.qfrc_bias) <= F64_PARITY


@pytest.mark.parametrize("leaf", ['<link name="leaf"/>', link("leaf", 0, (0, 0, 0))])
def test_a_joint_that_moves_no_mass_is_refused_by_name(leaf: str) -> None:
    frame = '<link name="tip"/>' + joint("weld2", "leaf", "tip", "fixed")
    text = chain(link("middle")).replace("</robot>", f"{leaf}{frame}</robot>")
    text = text.replace("</robot>", joint("idle", "hand", "leaf") + "</robot>")
    with pytest.raises(rb.ModelError) as caught:
        rb.load(text)
    message = str(caught.value)
    for word in ("idle (link leaf)", "singular", "expected mass", "<inertial>", "type='fixed'"):
        assert word in message
    assert "turn" not in message and "slide" not in message


@pytest.mark.parametrize("mass", [1.5, 1e-12])
def test_a_point_on_its_own_axis_is_refused_too(mass: float) -> None:
    """Also on a light base: moments are about the robot's centre, which that could mislay."""
    text = chain(link("middle")).replace(link("base"), link("base", mass, (mass, mass, mass)))
    text = text.replace("prismatic", "continuous")
    assert rb.load(text, floating_base=True).nv == 8
    point = '<link name="p"><inertial><mass value="1"/></inertial></link>'
    text = text.replace("</robot>", f"{point}{joint('j', 'hand', 'p')}</robot>")
    with pytest.raises(rb.ModelError, match=r"move no mass: j \(link p\);"):
        rb.load(text, floating_base=True)


# ---------------------------------------------------------------------------- other kinds of joints


def test_a_planar_joint_is_that_of_pinocchio() -> None:
    """Where its plane is that of x and y; Pinocchio takes every plane for that one."""
    text = chain(link("middle"), kind="planar").replace('xyz="0 1 0"', 'xyz="0 0 1"')
    assert error_beside_pinocchio(text) <= F64_PARITY


def test_a_floating_joint_below_the_world_is_that_of_pinocchio() -> None:
    world = ('<link name="world"/>', joint("float", "world", "base", "floating"))
    text = urdf(*world, link("base"), link("arm"), joint("j", "base", "arm"))
    text = text.replace('<origin xyz="0 0 1" rpy="0.1 0.2 0.3"/>', "")  # q counts from the parent
    assert error_beside_pinocchio(text) <= F64_PARITY


def test_joints_that_mimic_move_on_their_own_if_asked_to_and_are_named() -> None:
    mimic = '<mimic joint="turn" multiplier="2"/></joint>'
    text = chain(link("middle")).replace(
        joint("slide", "middle", "hand", "prismatic"),
        joint("slide", "middle", "hand", "continuous").replace("</joint>", mimic),
    )
    with pytest.warns(UserWarning, match="mimic"):
        model = rb.load(text, constraints=False, floating_base=False)
    assert model.nv == 2
    assert model.dropped == ("mimic joints, which move on their own (slide of turn)",)
    with pytest.raises(rb.UnsupportedFeature, match="slide of turn"):
        rb.load(text, strict=True, constraints=False)
    assert error_beside_pinocchio(text) <= F64_PARITY


# ---------------------------------------------------------------------------- bad files


XACRO = '<robot name="r" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:arm n="1"/></robot>'
BAD = [  # source, words that the sentence must have
    (XACRO, ["xacro's macros", "expected URDF", "run xacro first"]),
    ('<robot><xacro:arm n="1"/></robot>', ["not well-formed", "run xacro first"]),
    ('<robot name="r"/>', ["no <link>", "expected at least one"]),
    (chain(link("middle", "abc")), ["'middle'", "value='abc'", "one finite number"]),
    (chain(link("middle", "inf")), ["'middle'", "value='inf'", "one finite number"]),
    (chain(link("middle", rpy="1 2")), ["rpy='1 2'", "3 finite numbers"]),
    (chain(link("middle", 1, ("x", 1, 1))), ["ixx='x'", "one finite number"]),
    (chain(link("middle").replace("iyz", "other")), ["'middle'", "<inertia> has no iyz", "add"]),
    (chain(link("middle") + link("middle")), ["'middle'", "its own name"]),
    (chain(link("middle")).replace("prismatic", "springy"), ["'slide'", "invalid joint type"]),
]


@pytest.mark.parametrize(("source", "words"), BAD, ids=range(len(BAD)))
def test_bad_urdf_is_refused_in_a_sentence(source: str, words: list[str]) -> None:
    with pytest.raises(rb.ModelError) as caught:
        rb.load(source)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_empty_file_is_refused(tmp_path: Path) -> None:
    (tmp_path / "robot.urdf").write_text(" \n")
    with pytest.raises(rb.ModelError, match=r"robot\.urdf: the file is empty; expected MJCF"):
        rb.load(tmp_path / "robot.urdf")


def test_the_world_does_not_float() -> None:
    text = urdf('<link name="world"/>', link("arm"), joint("j", "world", "arm"))
    with pytest.raises(rb.ModelError, match=r"'world' is the ground.*give it an <inertial>"):
        rb.load(text, floating_base=True)


# ---------------------------------------------------------------------------- everyone's robots


SINGULAR = {  # hands and grippers of links without mass
    "romeo_description/urdf/romeo.urdf": "LFinger11Link",
    "romeo_description/urdf/romeo_laas_small.urdf": "l_gripper_joint",
}
EMPTY = {"ur_description/urdf/ur3.urdf"}  # a <robot> of nothing


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in REFUSED if name.endswith(".urdf")])
def test_what_mujoco_refuses_is_as_pinocchio_has_it(name: str) -> None:
    assert error_beside_pinocchio(REFUSED[name].path) <= F64_PARITY


@pytest.mark.slow
def test_robots_of_example_robot_data() -> None:
    try:
        files = importlib.metadata.files("example-robot-data") or []
    except importlib.metadata.PackageNotFoundError:
        pytest.skip("example-robot-data is not installed (pip install example-robot-data)")
    seen, wrong = 0, {}
    for path in sorted(Path(str(f.locate())) for f in files if f.suffix == ".urdf"):
        name = "/".join(path.parts[path.parts.index("robots") + 1 :])
        seen += 1
        if name in SINGULAR or name in EMPTY:
            with pytest.raises(rb.ModelError, match=SINGULAR.get(name, "no <link>")):
                rb.load(path)
            continue
        free = '<link name="world"' not in path.read_text()
        error = error_beside_pinocchio(path, floating_base=free, states=2)
        if not error <= F64_PARITY:
            wrong[name] = error
    assert seen and not wrong
