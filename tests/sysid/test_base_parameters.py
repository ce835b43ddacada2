"""Numbers of base parameters against the oracle (Pinocchio's regressors, 13 decades of gap)."""

import warnings
from pathlib import Path

import mujoco
import numpy as np
import pytest

import rbjax as rb
from benchmarks.cases.models import MODELS
from rbjax import sysid
from rbjax.loading import compile_model
from tests.oracles import load
from tests.robots import load_quietly
from tests.sysid.arms import chain, gravity_of

ORACLE = load("identification")
BASE = ORACLE["base_parameters"]
GO2 = Path(__file__).parents[3] / "shared" / "data" / "go2_in_air" / "go2_in_air.xml"
QUICK = {"planar_2R", "planar_3R"}
ARMS = [
    pytest.param(arm, gravity, marks=[] if arm in QUICK else [pytest.mark.slow])
    for arm, entry in BASE["arms"].items()
    for gravity in entry["counts"]
]


def ranks(model, **options):
    """Without and with a rotor inertia at each joint, and sure: ten decades at least."""
    both = [
        sysid.torque.base_parameters(model, joint_terms=terms, **options)
        for terms in ((), ("armature",))
    ]
    for found in both:
        assert found.gap[0] > 1e-2 and found.gap[1] < 1e-13
    return [found.rank for found in both]


@pytest.mark.parametrize(("arm", "gravity"), ARMS)
def test_arms(arm, gravity):
    entry = BASE["arms"][arm]
    model = chain(entry["joints"], gravity_of(gravity))
    assert ranks(model) == entry["counts"][gravity]


def test_what_can_be_found_of_the_55():
    """The five-joint arm: bodies and armatures, by name."""
    want = ORACLE["arm_5"]["what_can_be_found_of_the_55"]
    model = load_quietly(ORACLE["arm_5"]["mjcf"])
    base = sysid.torque.base_parameters(model, joint_terms=["armature"])
    assert base.rank == want["rank_random_states"] == 32 and len(base.names) == 55

    def name(entry):
        return f"{entry[0]}.{entry[1].replace('m', 'h') if len(entry[1]) == 2 else entry[1]}"

    by_itself = zip(range(1, 6), want["armature_found_alone"], strict=True)
    armatures = [f"joint{k}.armature" for k, yes in by_itself if yes]
    single = [name(x) for x in want["single_entries_found_alone"]]
    assert sorted(base.single) == sorted([*single, *armatures])
    assert sorted(base.hidden) == sorted(name(x) for x in want["entries_that_never_show"])
    words = base.summary()
    for group in (
        "link1.Izz + link2.Izz + link3.Izz + joint1.armature",
        "link2.Iyy + 0.01 link3.m + 0.01 link4.m + 0.01 link5.m + joint2.armature",
        "link2.hz + 0.1 link3.m + 0.1 link4.m + 0.1 link5.m",
    ):
        assert f"{group} is identifiable; none of them by itself." in words
    # with the inertia held, the armature is what is found; it can be asked for
    preferred = sysid.torque.base_parameters(
        model, joint_terms=["armature"], first=["joint1.armature", "joint2.armature"]
    )
    kept = [preferred.names[k] for k in preferred.kept]
    assert {"joint1.armature", "joint2.armature"} < set(kept) and "link1.Izz" not in kept


def test_one_motion_and_some_of_the_torques():
    """A motion of one joint shows less than random ones; so does one torque of two."""
    model = load_quietly("double_pendulum")
    every = sysid.torque.base_parameters(model)
    t = np.linspace(0.0, 3.0, 50)[:, None]
    still = np.zeros_like(t)
    xs = [np.concatenate([still, x], 1) for x in (np.sin(t), np.cos(t), -np.sin(t))]
    one = sysid.torque.base_parameters(model, *xs)
    assert one.rank < every.rank
    lower = sysid.torque.base_parameters(model, rows=[model.joint_names[1]])
    assert lower.rank < every.rank
    assert all(model.body_names[1] in x for x in (*lower.single, *lower.terms()))


def humanoid(*, held: bool, split: bool, gravity: bool) -> rb.Model:
    """Gymnasium's humanoid; `split` puts a body between joints that share one."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        m = MODELS["gymnasium/humanoid.xml"].load()
    if not gravity:
        m.opt.gravity[:] = 0.0
    if not (held or split):
        return load_quietly(m)
    g = " ".join(map(str, m.opt.gravity))
    text = f'<mujoco><compiler angle="radian"/><option gravity="{g}"/><worldbody>'
    return load_quietly(text + _children(m, 0, held, split) + "</worldbody></mujoco>")


def _children(m: mujoco.MjModel, parent: int, held: bool, split: bool) -> str:
    """Its bodies as MJCF. Inertias are made up: a regressor does not know them."""
    inertial = '<inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
    text = ""
    for b in range(1, m.nbody):
        if m.body_parentid[b] != parent:
            continue
        pos, quat = (" ".join(map(repr, map(float, x[b]))) for x in (m.body_pos, m.body_quat))
        joints = []
        for j in range(m.body_jntadr[b], m.body_jntadr[b] + m.body_jntnum[b]):
            if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
                joints += [] if held else ["<freejoint/>"]
                continue
            axis, at = (" ".join(map(repr, map(float, x[j]))) for x in (m.jnt_axis, m.jnt_pos))
            joints.append(f'<joint name="j{j}" axis="{axis}" pos="{at}"/>')
        between = f"{inertial}<body>" if split else ""
        inner = between.join(joints) + inertial + _children(m, b, held, split)
        closing = "</body>" * (max(len(joints), 1) if split else 1)
        text += f'<body pos="{pos}" quat="{quat}">{inner}{closing}'
    return text


ROWS = {
    "all_23_rows": None, "all": None, "joint_torques_only": slice(6, None),
    "base_wrench_only": slice(0, 6),
}  # fmt: skip
HUMANOID = [
    pytest.param(case, rows, bodies, id=f"{case}, {rows}, {bodies}")
    for case, by_rows in BASE["humanoid"].items()
    for rows, by_bodies in by_rows.items()
    for bodies in by_bodies
]


@pytest.mark.slow
@pytest.mark.parametrize(("case", "rows", "bodies"), HUMANOID)
def test_humanoid(case, rows, bodies):
    model = humanoid(
        held="base_held" in case, split=bodies == "every_joint_frame", gravity="on" in case
    )
    found = sysid.torque.base_parameters(model, rows=ROWS[rows], samples=150)
    assert found.rank == BASE["humanoid"][case][rows][bodies]
    assert found.gap[0] > 1e-2 and found.gap[1] < 1e-13


@pytest.mark.slow
@pytest.mark.skipif(not GO2.exists(), reason=f"{GO2} is not there")
@pytest.mark.parametrize("gravity", BASE["go2_base_held"])
def test_go2_with_its_base_held(gravity):
    compiled = compile_model(GO2.read_text())
    if gravity == "none":
        compiled.opt.gravity[:] = 0.0
    model = load_quietly(compiled)
    assert ranks(model, samples=150) == BASE["go2_base_held"][gravity]
    base = sysid.torque.base_parameters(model, joint_terms=["armature"], samples=150)
    armatures = [x for x in base.single if "armature" in x]
    assert len(armatures) == 4 and all("calf" in x for x in armatures)
    assert all(f"base.{x}" in base.hidden for x in ("m", "hx", "Izz"))
