"""The oracles are right: MuJoCo C reproduces the numbers; every model and seed here loads."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from pathlib import Path

import mujoco
import numpy as np
import pytest

from benchmarks.cases.models import (
    MISSING,
    MODELS,
    REFUSED,
    SINGULAR,
    load_with_removals,
    switch_off_constraints,
)
from benchmarks.cases.random_trees import (
    acceleration_to_pinocchio,
    pinocchio_model,
    pinocchio_velocity_map,
    random_state,
    random_tree,
    to_pinocchio,
)
from tests.oracles import load
from tests.oracles.textbook import Case, modern_robotics, planar_2r, rbdl, tip_forces, two_link

Array = np.ndarray
SCENES = sorted((Path(__file__).parents[2] / "rbjax" / "loading" / "scenes").glob("*.xml"))


def mass_matrix(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    out = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, out)  # MuJoCo 4's order of arguments
    return out


def at(case: Case, q: object, v: object = 0.0) -> tuple[mujoco.MjModel, mujoco.MjData]:
    model = case.model()
    data = mujoco.MjData(model)
    data.qpos, data.qvel = case.scale * np.array(q), case.scale * np.array(v)
    mujoco.mj_forward(model, data)
    return model, data


@pytest.mark.parametrize("name", ["three_link", "UR5"])
def test_modern_robotics(name: str) -> None:
    case = modern_robotics(name)
    s, oracle, book = case.scale, case.data["recomputed"], case.data["published"]
    model, data = at(case, case.data["q"], case.data["v"])
    got = {"MassMatrix": s[:, None] * mass_matrix(model, data) * s}
    tip = tip_forces(case, data)
    got["EndEffectorForces"] = s * tip
    data.qacc = s * case.data["a"]
    mujoco.mj_inverse(model, data)
    got["InverseDynamics"] = s * (data.qfrc_inverse + tip)
    data.qfrc_applied = case.data["tau"] / s - tip
    mujoco.mj_forward(model, data)
    got["ForwardDynamics"] = data.qacc / s
    got["VelQuadraticForces"] = s * data.qfrc_bias - oracle["GravityForces"]
    model, data = at(case, case.data["q"])
    got["GravityForces"] = s * data.qfrc_bias
    for key, value in got.items():
        np.testing.assert_allclose(value, oracle[key], rtol=0, atol=1e-12, err_msg=key)
        coarse = name == "UR5" and key == "VelQuadraticForces"  # printed to six decimals
        atol = 1e-6 if coarse else 1e-8
        np.testing.assert_allclose(
            value, book[key], rtol=1e-8, atol=atol, err_msg=f"{key}, printed"
        )


@pytest.mark.parametrize("fall", ["home", "elbow"])
def test_ur5_falls_from_rest(fall: str) -> None:
    case = modern_robotics("UR5")
    runs = case.data["falling_from_rest"]
    model, data = at(case, runs["start"][fall])
    for _ in range(500):
        mujoco.mj_step(model, data)  # RK4 at 1 ms
        if round(data.time * 1000) in (250, 500):
            end = runs[fall][f"{data.time:.2f}".rstrip("0")]
            np.testing.assert_allclose(data.qpos, end["q"], rtol=0, atol=2e-8)
            np.testing.assert_allclose(data.qvel, end["v"], rtol=0, atol=2e-6)


def test_planar_2r() -> None:
    case = planar_2r()
    model, data = at(case, case.data["theta"], case.data["thetadot"])
    np.testing.assert_allclose(mass_matrix(model, data), case.data["M"], rtol=0, atol=1e-13)
    bias = np.add(case.data["c"], case.data["grav"])
    np.testing.assert_allclose(data.qfrc_bias, bias, rtol=0, atol=1e-12)


@pytest.mark.parametrize("row", load("two_link_table41")["rows"])
def test_table_41(row: list[float]) -> None:
    m2, theta2, *expected = row
    model, data = at(two_link(m2), [0.3, np.radians(theta2)])
    (d11, d12), (_, d22) = mass_matrix(model, data)
    got = [d11, d12, d22, d11, d11 - d12**2 / d22]
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-13 * max(1, m2))
    first, both = np.sin(0.3), np.sin(0.3 + np.radians(theta2))
    gravity = 9.81 * np.array([(2 + m2) * first + m2 * both, m2 * both])
    np.testing.assert_allclose(data.qfrc_bias, gravity, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", load("rbdl_cases")["cases"])
def test_rbdl(name: str) -> None:
    case = rbdl(name)
    model, data = at(case, case.data["q"])
    data.qfrc_applied = case.data.get("tau", 0.0)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, case.data["qdd"], rtol=0, atol=2e-14)


def test_random_trees_compile_and_repeat() -> None:
    kinds, shared, welded = set(), 0, 0
    for seed in range(50):
        text = random_tree(seed)
        assert text == random_tree(seed)
        model = mujoco.MjModel.from_xml_string(text)
        data = mujoco.MjData(model)
        data.qpos, data.qvel = random_state(model, seed)
        mujoco.mj_forward(model, data)
        assert 1 <= model.nbody - 1 <= 12
        assert np.linalg.cond(mass_matrix(model, data)) < 1e5
        kinds |= set(model.jnt_type.tolist())
        shared += int((model.body_jntnum > 1).sum())
        welded += int((model.body_jntnum[1:] == 0).sum())
    assert kinds == {0, 1, 2, 3} and shared > 20 and welded > 20


@pytest.mark.parametrize("seed", range(20))
def test_pinocchio_agrees_on_safe_trees(seed: int) -> None:
    pinocchio = pytest.importorskip("pinocchio", reason="pin is not installed")
    text = random_tree(seed, pinocchio_safe=True)
    model, peer = mujoco.MjModel.from_xml_string(text), pinocchio_model(text)
    data, peer_data = mujoco.MjData(model), peer.createData()
    q, v = random_state(model, seed)
    a = np.random.default_rng(seed).normal(size=model.nv)
    data.qpos, data.qvel = q, v
    mujoco.mj_forward(model, data)
    (qp, vp), vel_map = to_pinocchio(model, q, v), pinocchio_velocity_map(model, q)
    upper = np.triu(pinocchio.crba(peer, peer_data, qp))
    mass = mass_matrix(model, data)
    peer_mass = vel_map.T @ (upper + np.triu(upper, 1).T) @ vel_map
    np.testing.assert_allclose(peer_mass, mass, rtol=0, atol=1e-11)
    ap = acceleration_to_pinocchio(model, q, v, a)
    tau = vel_map.T @ pinocchio.rnea(peer, peer_data, qp, vp, ap)
    np.testing.assert_allclose(tau, mass @ a + data.qfrc_bias, rtol=1e-10, atol=1e-9)


@pytest.mark.parametrize("path", SCENES, ids=lambda p: p.stem)
def test_scenes_compile_quietly(path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    assert "timestep=" in path.read_text()
    assert set(switch_off_constraints(model)) <= {"equality"}  # smooth dynamics and loops, no more
    for key in range(model.nkey):
        mujoco.mj_resetDataKeyframe(model, data, key)
        for _ in range(100):
            mujoco.mj_step(model, data)
        assert np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()
    assert capfd.readouterr() == ("", "")  # and warnings are errors here


def test_scene_two_link_is_the_book_arm() -> None:
    (path,) = (p for p in SCENES if p.stem == "two_link")
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    data.qpos, data.qvel = [0.3, 0.9], [1.0, -2.0]
    mujoco.mj_forward(model, data)
    book, book_data = at(two_link(1.0), data.qpos, data.qvel)
    np.testing.assert_allclose(mass_matrix(model, data), mass_matrix(book, book_data), atol=1e-14)
    np.testing.assert_allclose(data.qfrc_bias, book_data.qfrc_bias, atol=1e-13)


def test_model_list_is_whole() -> None:
    if MISSING:
        pytest.skip(f"not installed, so the list is shorter: {', '.join(MISSING)}")
    assert len(MODELS) >= 65


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass'", "ignore:Inertia matrix is")
@pytest.mark.parametrize("name", MODELS)
def test_models_load(name: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)  # where MuJoCo writes its log of warnings
    entry = MODELS[name]
    model = entry.load()
    switch_off_constraints(model)
    data = mujoco.MjData(model)
    data.qvel = np.random.default_rng(0).normal(size=model.nv)
    mujoco.mj_forward(model, data)
    assert data.nefc == 0 and data.ncon == 0
    if name not in SINGULAR and model.nv:
        assert np.linalg.cond(mass_matrix(model, data)) < 1e8
    if entry.floating_base:  # the root link's mass counts
        masses = ElementTree.parse(entry.path).iterfind("link/inertial/mass")
        assert np.isclose(model.body_mass.sum(), sum(float(m.get("value", 0)) for m in masses))


@pytest.mark.parametrize("name", REFUSED)
def test_unloadable_models_still_are(name: str) -> None:
    with pytest.raises(ValueError):
        load_with_removals(REFUSED[name].path)
