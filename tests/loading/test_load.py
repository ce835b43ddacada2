"""Loaded files: joints, names, welds, details of URDF; features left out; every bad input."""

import itertools
import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.models import mujoco_reference
from rbjax.loading import compile_model
from tests.robots import SMALL, load_quietly
from tests.tolerances import F64_PARITY, F64_ROUNDING, relative_error

MASS = '<inertial pos="0 0 0.1" mass="2" diaginertia="0.1 0.2 0.25"/>'


def mjcf(*bodies: str, extra: str = "") -> str:
    return f"<mujoco><worldbody>{''.join(bodies)}</worldbody>{extra}</mujoco>"


def body(*content: str, name: str = "b") -> str:
    return f'<body name="{name}" pos="1 0 0">{"".join(content)}{MASS}</body>'


@pytest.fixture(autouse=True)
def _elsewhere(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log of warnings


# ---------------------------------------------------------------------------- what is kept


@pytest.mark.parametrize(
    ("joint", "kind", "nq", "nv"),
    [
        ('<joint name="j" axis="0 1 0"/>', "hinge", 1, 1),
        ('<joint name="j" type="slide"/>', "slide", 1, 1),
        ('<joint name="j" type="ball"/>', "ball", 4, 3),
        ('<freejoint name="j"/>', "free", 7, 6),
    ],
)
def test_each_joint_type(joint: str, kind: str, nq: int, nv: int) -> None:
    model = rb.load(mjcf(body(joint)))
    assert (model.nq, model.nv, model.nb, model.nu) == (nq, nv, 1, 0)
    assert model.topology.joint_kinds == (kind,) and model.joint_names == ("j",)
    state = model.default_state()
    assert state.q.shape == (nq,) and state.v.shape == (nv,)
    assert relative_error(rb.forward_kinematics(model, state.q).p, [[1, 0, 0]]) <= F64_ROUNDING


def test_several_joints_on_a_body_and_welds_and_names() -> None:
    model = load_quietly(SMALL)
    assert model.joint_names == ("slide", "hinge", "ball")
    assert model.body_names == ("slider", "swinger", "hand", "plate")
    assert model.topology.joint_bodies == (0, 0, 1)
    assert model.topology.carriers == (0, 1, 1, -1)  # the hand is welded, the plate is furniture
    assert model.actuator_names == ("push", "servo", "twist", "jet", "brake")
    assert model.site_names == ("tip",) and model.keyframe_names == ("bent",)
    assert model.timestep == 0.001
    assert (model.nq, model.nv, model.nb, model.nu) == (6, 5, 4, 5)


def test_leaves_are_the_numbers_of_the_file() -> None:
    model, m = load_quietly(SMALL), compile_model(SMALL)
    full = [[0.02, 0.002, -0.003], [0.002, 0.03, 0.001], [-0.003, 0.001, 0.025]]
    np.testing.assert_array_equal(model.bodies.mass, [1.5, 0.8, 0.4, 1.0])
    np.testing.assert_allclose(model.bodies.com[0], [0.05, 0.1, -0.03])
    np.testing.assert_allclose(model.bodies.inertia[0], full, atol=1e-14)
    np.testing.assert_array_equal(model.joints.armature, [0.05, 0.1, 0, 0, 0])
    np.testing.assert_array_equal(model.joints.damping, [0.4, 0.2, 0.1, 0.1, 0.1])
    np.testing.assert_array_equal(model.joints.stiffness, [5.0, 0.0, 2.0])
    np.testing.assert_array_equal(model.gravity, [0.5, -1.0, -9.0])
    np.testing.assert_array_equal(model.joints.springref[0], 0.3)
    np.testing.assert_array_equal(model.default_state().q, m.qpos0)
    np.testing.assert_array_equal(model.actuators.ctrlrange[0], [-0.5, 0.5])
    np.testing.assert_array_equal(model.actuators.forcerange[1], [-2, 2])
    assert np.isinf(model.actuators.ctrlrange[2]).all()
    state = model.keyframe("bent")
    np.testing.assert_array_equal(state.v, [1, 2, 3, 4, 5])


def test_ranges_of_joints() -> None:
    """In radians and metres, whatever the file's degrees; infinite where it sets none."""
    text = mjcf(
        f"""<body><joint name="hinge" range="-90 45"/>{MASS}
        <body><joint name="slide" type="slide" range="-1 2"/>{MASS}
        <body><joint name="none"/>
        <joint name="off" axis="1 0 0" range="-1 1" limited="false"/>{MASS}
        <body><joint name="ball" type="ball" range="0 60"/>{MASS}</body></body></body></body>"""
    )
    model = load_quietly(text)
    inf, pi = np.inf, np.pi
    want = [[-pi / 2, pi / 4], [-1, 2], [-inf, inf], [-inf, inf], [0, pi / 3]]
    np.testing.assert_allclose(model.joints.range, want, rtol=1e-15)
    off = text.replace("<mujoco>", '<mujoco><option><flag limit="disable"/></option>')
    assert off != text and np.isinf(load_quietly(off).joints.range).all()


def test_names_for_what_has_none() -> None:
    model = rb.load(mjcf(f"<body><joint/>{MASS}</body>", f"<body>{MASS}</body>"))
    assert model.body_names == ("body1", "body2") and model.joint_names == ("joint0",)


def test_every_kind_of_source_gives_the_same_model(tmp_path: Path) -> None:
    text = mjcf(body('<joint axis="0 1 0"/>'))
    (tmp_path / "robot.xml").write_text(text)
    spec, compiled = mujoco.MjSpec.from_string(text), mujoco.MjModel.from_xml_string(text)
    sources = [text, f"\n  {text}", tmp_path / "robot.xml", str(tmp_path / "robot.xml")]
    models = [rb.load(source) for source in (*sources, spec, compiled)]
    for a, b in itertools.pairwise(models):
        assert a.topology == b.topology
        np.testing.assert_array_equal(a.bodies.inertia, b.bodies.inertia)


@pytest.mark.parametrize("name", rb.scenes())
def test_scenes_load_whole(name: str) -> None:
    model = rb.load(name, strict=True)
    assert model.dropped == () and model.nv > 0


def test_switched_off_in_the_file_is_off_in_the_model() -> None:
    flags = '<option><flag gravity="disable" spring="disable" damper="disable"/></option>'
    model = rb.load(mjcf(body('<joint stiffness="1" damping="1"/>'), extra=flags))
    assert not model.gravity.any()
    assert not model.joints.stiffness.any() and not model.joints.damping.any()


def test_an_included_file_is_found(tmp_path: Path) -> None:
    (tmp_path / "part.xml").write_text(f"<mujocoinclude>{body('<joint/>')}</mujocoinclude>")
    (tmp_path / "robot.xml").write_text(mjcf('<include file="part.xml"/>'))
    assert rb.load(tmp_path / "robot.xml").body_names == ("b",)


# ---------------------------------------------------------------------------- URDF


def link(name: str, mass: float = 1.0, shape: str = "") -> str:
    inertia = '<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/>'
    inertial = f'<inertial><origin xyz="0 0 0.1"/><mass value="{mass}"/>{inertia}</inertial>'
    return f'<link name="{name}">{inertial if mass else ""}{shape}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute") -> str:
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        '<origin xyz="0 0 1" rpy="0.1 0.2 0.3"/><axis xyz="0 1 0"/>'
        '<limit lower="-1" upper="1" effort="9" velocity="1"/></joint>'
    )


def urdf(*content: str) -> str:
    return f'<robot name="r">{"".join(content)}</robot>'


ARM = (link("base", 3), link("arm"), joint("elbow", "base", "arm", "continuous"))


def test_urdf_root_is_fixed_unless_asked() -> None:
    fixed = rb.load(urdf(*ARM), floating_base=False)
    assert (fixed.nv, fixed.joint_names) == (1, ("elbow",))
    model = rb.load(urdf(*ARM), floating_base=True)
    assert model.nv == 7 and model.topology.joint_kinds == ("free", "hinge")
    assert model.joint_names == ("floating_base", "elbow")
    assert model.body_names[-2:] == ("base", "arm")
    M = rb.mass_matrix(model, model.default_state().q)
    np.testing.assert_allclose(M[:3, :3], 4 * np.eye(3), atol=1e-12)  # the root's mass counts


def test_urdf_ranges() -> None:
    """Of a revolute and a prismatic joint; a continuous one has none, though the file says so."""
    slide = (link("finger"), joint("grip", "hand", "finger", "prismatic"))
    model = load_quietly(urdf(*ARM, link("hand"), joint("wrist", "arm", "hand"), *slide))
    assert model.joint_names == ("elbow", "wrist", "grip")
    np.testing.assert_array_equal(model.joints.range, [[-np.inf, np.inf], [-1, 1], [-1, 1]])


def test_urdf_fixed_links_keep_their_names_and_mass() -> None:
    tool = (link("tool", 2), joint("weld", "arm", "tool", "fixed"))
    model = rb.load(urdf(*ARM, *tool), floating_base=False)
    assert "tool" in model.body_names and model.nv == 1
    assert float(model.bodies.mass[model.body("tool")]) == 2.0
    assert rb.jacobian(model, model.default_state().q, "tool").shape == (6, 1)
    alone = rb.load(urdf(*ARM), floating_base=False)
    q = np.array([0.3])
    assert rb.mass_matrix(model, q)[0, 0] > rb.mass_matrix(alone, q)[0, 0]


@pytest.mark.parametrize("file", ["gone.stl", "package://somewhere/gone.dae", "/no/such/mesh.obj"])
def test_urdf_meshes_are_not_needed(file: str) -> None:
    mesh = f'<geometry><mesh filename="{file}"/></geometry>'
    shape = f'<visual>{mesh}<material name="steel"/></visual><collision>{mesh}</collision>'
    text = urdf('<material name="steel"/>', link("base"), link("arm", 1, shape), ARM[2])
    model = load_quietly(text, floating_base=False)
    assert model.nv == 1 and model.dropped == ("collision meshes of links (arm)",)


def test_urdf_mass_is_never_that_of_a_shape() -> None:
    box = '<collision><geometry><box size="1 1 1"/></geometry></collision>'
    text = urdf(*ARM, link("frame", 0, box), joint("w", "arm", "frame", "fixed"))
    model = load_quietly(text, floating_base=False)
    assert float(model.bodies.mass[model.body("frame")]) == 0.0


def test_urdf_inertial_of_zeros_means_none() -> None:
    zeros = '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
    nothing = f'<link name="n"><inertial><mass value="0"/>{zeros}</inertial></link>'
    assert load_quietly(urdf(*ARM, nothing, joint("w", "arm", "n", "fixed"))).nb >= 2


def test_urdf_is_read_in_the_encoding_that_it_declares(tmp_path: Path) -> None:
    text = '<?xml version="1.0" encoding="ISO-8859-1"?>' + urdf(*ARM).replace("elbow", "codé")
    (tmp_path / "arm.urdf").write_bytes(text.encode("latin-1"))
    assert load_quietly(tmp_path / "arm.urdf").joint_names == ("codé",)


def test_urdf_agrees_with_mujoco() -> None:
    text = urdf(*ARM, link("slider"), joint("rail", "arm", "slider", "prismatic"))
    model, m = load_quietly(text, floating_base=True), mujoco_reference(text, floating_base=True)
    data = mujoco.MjData(m)
    rng = np.random.default_rng(0)
    data.qpos, data.qvel = rng.normal(size=m.nq), rng.normal(size=m.nv)
    mujoco.mj_forward(m, data)
    got = rb.bias_forces(model, data.qpos, data.qvel)
    assert relative_error(got, data.qfrc_bias) <= F64_PARITY


# ---------------------------------------------------------------------------- what is left out


DROPPED = {  # word of the message: file that has it
    "contacts": mjcf(body("<freejoint/>", '<geom size="1"/>'), '<geom type="plane" size="1 1 1"/>'),
    "joint limits (knee)": mjcf(
        body('<joint name="knee" limited="true" range="0 1"/>')
    ),
    "joint friction loss (dry)": mjcf(body('<joint name="dry" frictionloss="1"/>')),
    "tendon friction loss (rope)": mjcf(
        body('<joint name="a"/>'),
        extra='<tendon><fixed name="rope" frictionloss="1"><joint joint="a" coef="1"/></fixed>'
        '<fixed name="idle"><joint joint="a" coef="1"/></fixed></tendon>',
    ),
    "poses of mocap bodies in keyframes (up)": mjcf(
        body("<joint/>"), '<body mocap="true" pos="0 0 1"/>',
        extra='<keyframe><key name="same"/><key name="up" mpos="0 0 2"/></keyframe>',
    ),
    "actuators: delays of controls (late)": mjcf(
        body('<joint name="a"/>'),
        extra='<actuator><motor name="late" joint="a" delay="0.1" nsample="50"/></actuator>',
    ),
    "actuators: adhesion, which needs contacts (gecko)": mjcf(
        body('<joint name="a"/>'),
        extra='<actuator><adhesion name="gecko" body="b" ctrlrange="0 1"/></actuator>',
    ),
    "tendon armature (idle)": mjcf(
        body('<joint name="a"/>'),
        extra='<tendon><fixed name="idle"><joint joint="a" coef="1"/></fixed></tendon>'
        '<actuator><motor name="m" tendon="idle" armature="1"/></actuator>',
    ),
}  # fmt: skip


@pytest.mark.parametrize("word", DROPPED)
def test_what_is_left_out_is_said_once(word: str) -> None:
    with pytest.warns(UserWarning, match="left out of the model") as caught:
        model = rb.load(DROPPED[word], contacts=False)
    assert len(caught) == 1 and caught[0].filename == __file__
    (entry,) = [d for d in model.dropped if d.startswith(word)]
    assert entry in str(caught[0].message)
    with pytest.raises(rb.UnsupportedFeature) as refused:
        rb.load(DROPPED[word], strict=True, contacts=False)
    for entry in model.dropped:
        assert entry in str(refused.value)
    assert "strict=False" in str(refused.value)


def test_many_names_are_cut_short() -> None:
    joints = "".join(
        f'<joint name="j{i}" type="slide" axis="{int(i % 3 == 0)} {int(i % 3 == 1)} '
        f'{int(i % 3 == 2)}" limited="true" range="0 1" armature="1"/>'
        for i in range(6)
    )
    with pytest.warns(UserWarning):
        model = rb.load(mjcf(body(joints)), contacts=False)
    assert model.dropped == ("joint limits (j0, j1, j2, j3 and 2 more)",)


def test_what_is_switched_off_is_not_left_out() -> None:
    off = '<option><flag contact="disable" limit="disable"/></option>'
    text = mjcf(
        body('<joint limited="true" range="0 1"/>', '<geom size="1"/>'),
        '<geom type="plane" size="1 1 1"/>', extra=off,
    )  # fmt: skip
    assert rb.load(text, strict=True).dropped == ()


# ---------------------------------------------------------------------------- bad input


CYCLE = (link("a"), link("b"), joint("x", "a", "b"), joint("y", "b", "a"))
MOTOR = '<actuator><motor joint="j" {}/></actuator>'
BAD = [  # source, words that the sentence must have
    ("/no/such/robot.xml", ["/no/such/robot.xml", "no such file", "give"]),
    ("<mujoco><worldbody>", ["XML string", "not well-formed", "expected MJCF"]),
    ("<html></html>", ["<html>", "expected <mujoco> (MJCF) or <robot> (URDF)"]),
    ("<mujoco><nonsense/></mujoco>", ["cannot parse", "nonsense"]),
    (mjcf('<body name="ghost"><joint/></body>'), ["ghost", "mass", "<inertial>"]),
    (mjcf(body('<joint axis="0 0 0"/>')), ["axis"]),
    (
        mjcf('<body><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/></body>'),
        ["balanceinertia"],
    ),
    (mjcf(body('<joint axis="0 nan 1"/>')), ["jnt_axis[0]", "not finite", "correct"]),
    (urdf(*CYCLE), ["cycle"]),
    (urdf(*ARM, *CYCLE), ["a, b", "cycle", "base"]),
    (urdf(*ARM, link("stray")), ["2 roots", "base", "stray"]),
    (urdf(*ARM, joint("extra", "base", "arm")), ["'arm'", "two joints"]),
    (urdf(*ARM, joint("lost", "base", "nowhere")), ["'lost'", "'nowhere'", "arm, base"]),
    (urdf(link("base"), link("arm", 0), ARM[2]), ["mass", "<inertial>", "fixed"]),
    (42, ["int", "expected a path", "pendulum"]),
    ("x" * 5000 + ".xml", ["... (5,004 characters): no such file; give"]),
    (mjcf(body("<joint/>"), body("<joint/>")), ["repeated name 'b'", "a name of its own"]),
    (urdf(*ARM, link("arm")), ["more than one link is named 'arm'", "its own name"]),
    (urdf(*ARM, link("c"), joint("elbow", "arm", "c")), ["more than one joint is named 'elbow'"]),
    (mjcf(body('<joint range="nan 1" limited="false"/>')), ["jnt_range[0] = [nan", "correct them"]),
    (mjcf(body('<joint actuatorfrcrange="nan 1"/>')), ["jnt_actfrcrange[0] = [nan", "correct"]),
    (
        mjcf(body('<joint name="j"/>'), extra=MOTOR.format('ctrlrange="nan 1"')),
        ["actuator_ctrlrange[0] = [nan"],
    ),
    (
        mjcf(body('<joint name="j"/>'), extra=MOTOR.format('forcerange="nan 1"')),
        ["actuator_forcerange[0] = [nan"],
    ),
    (mjcf(body("<joint/>"), extra='<option timestep="0"/>'), ["timestep is 0.0", "positive"]),
    (mjcf(body("<joint/>"), extra='<option timestep="nan"/>'), ["timestep is nan", "positive"]),
]


@pytest.mark.parametrize(("source", "words"), BAD, ids=range(len(BAD)))
def test_bad_input_is_refused_in_a_sentence(source, words: list[str]) -> None:
    with pytest.raises(rb.ModelError) as caught:
        rb.load(source)
    for word in words:
        assert word in str(caught.value)
    assert "\n" not in str(caught.value)


def test_an_unknown_scene_lists_the_scenes() -> None:
    with pytest.raises(rb.UnknownName) as caught:
        rb.load("penduluum")
    assert "'penduluum'" in str(caught.value)
    assert all(repr(name) in str(caught.value) for name in rb.scenes())
    for name in ("x" * 5000, "a\0b"):
        with pytest.raises(rb.UnknownName, match="known names: ") as caught:
            rb.load(name)
        assert len(str(caught.value)) < 1000


def test_a_folder_or_a_picture_is_not_a_robot(tmp_path: Path) -> None:
    (tmp_path / "robot.xml").write_bytes(b"\xff\xfe\x00\x80picture")
    for path in (tmp_path, tmp_path / "robot.xml"):
        with pytest.raises(rb.ModelError, match=r"cannot be read as text|not a regular file"):
            rb.load(path)


def test_values_that_are_not_finite_are_refused() -> None:
    for field in ("body_mass", "qpos0", "body_inertia", "body_pos", "jnt_axis", "dof_damping"):
        broken = mujoco.MjModel.from_xml_string(mjcf(body("<joint/>")))
        getattr(broken, field)[-1] = np.nan
        with pytest.raises(rb.ModelError, match="not finite"):
            rb.load(broken)


def test_floating_base_is_for_urdf() -> None:
    with pytest.raises(rb.ModelError, match="<freejoint/>"):
        rb.load("pendulum", floating_base=True)


def test_nothing_is_warned_about_a_clean_file() -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        rb.load("cart_pole")
