"""`rbjax identify`: the example, its files, going on, and errors that name what is wrong."""

import json
import types

import numpy as np
import pytest
from typer.testing import CliRunner

import rbjax as rb
from rbjax.cli import app
from rbjax.sysid import Grid, Inertia, Status, Tilt
from rbjax.sysid.jobs.example import CONFIGURATION, TRUTH, write_example
from rbjax.sysid.jobs.job import Job, Results
from rbjax.sysid.statistics import estimates


def run(*args, code=0):
    result = CliRunner().invoke(app, ["identify", *map(str, args)])
    assert result.exit_code == code, (result.output, result.exception)
    return result


@pytest.mark.slow
def test_the_example_finds_its_truth_and_writes_the_robot(tmp_path):
    run(tmp_path, "--example")
    said = run(tmp_path / "identify.toml").stdout
    assert "the model holds" in said and "fore mass" in said
    fit = json.loads((tmp_path / "found" / "fit.json").read_text())
    for name, truth in TRUTH.items():
        assert abs(fit["values"][name] - truth) < 4 * fit["sigma"][name] < 0.05
    robot = rb.load(tmp_path / "found" / "arm-found.xml")
    np.testing.assert_allclose(robot.bodies.mass[1], fit["values"]["fore mass"], rtol=1e-6)
    assert "capsule" in (tmp_path / "found" / "arm-found.xml").read_text()
    page = (tmp_path / "found" / "report.html").read_text()
    assert "The model holds" in page and page.count("data:image/png") >= 5
    run(tmp_path / "identify.toml", "--resume")
    again = json.loads((tmp_path / "found" / "fit.json").read_text())
    np.testing.assert_allclose([*again["values"].values()], [*fit["values"].values()], rtol=1e-4)


@pytest.mark.parametrize(
    ("old", "new", "error"),
    [
        ("[recordings]", "[recording]", "recording"),
        ('sensor = "q", joint = "elbow"', 'senor = "q", joint = "elbow"', "senor|expected"),
        ('leaf = "bodies.mass"', 'leaf = "bodies.mas"', "bodies.mass"),
        ('index = "fore"', 'index = "hand"', "fore"),
        ("run1.csv", "run9.csv", "run1.csv"),
        ("run1.csv", "run1.mat", ".npz"),
        ("[unknowns]", "[unknowns", "is not a TOML file"),
        ('model = "arm.xml"', "", "has no model"),
        ("[output]\nfolder", "[[output]]\nfolder", "expected a table"),
        ("estimate_initial_state = true", "begin = true", "begin"),
        ('fit = ["run1.csv", "run2.csv"]', "", "has no fit"),
        ('{ sensor = "q", joint = "elbow", unit = "deg", sign = -1 }', '"q"', "elbow angle"),
        ('{ leaf = "joints.damping", positive = true }', '"damping"', "one of leaf, inertia"),
        ('leaf = "joints.damping", positive', 'leaf = "joints.damping", sign', "sign"),
    ],
)
def test_what_is_wrong_with_a_configuration_is_named(tmp_path, old, new, error):
    path = write_example(tmp_path)
    assert old in CONFIGURATION
    path.write_text(CONFIGURATION.replace(old, new))
    with pytest.raises(rb.RbjaxError, match=error):
        Job.read(path)


def test_a_missing_file_says_how_to_begin(tmp_path):
    assert "--example" in " ".join(run(tmp_path / "none.toml", code=2).stderr.split())


PENDULUM = """
model = "cart_pole"
motors = false
[recordings]
fit = "run.npz"
[columns]
angles = { sensor = "q" }
forces = { sensor = "ctrl" }
[unknowns]
mass = { leaf = "bodies.mass", index = "pole", bounds = [0.01, 1] }
damping = { leaf = "joints.damping", index = "hinge", positive = true }
both = { leaf = "joints.armature", index = ["slider", "hinge"] }
pole = { inertia = "pole" }
level = { tilt = true }
[controller]
kp = 3.0
delay = 0.012
[options]
substeps = 2
period = 0.02
"""


def test_what_a_configuration_says(tmp_path):
    model = rb.load("cart_pole")
    t = np.arange(11) * 0.02
    names = dict(zip(("slider", "hinge"), model.joint_names, strict=True))
    names["pole"] = model.body_names[-1]
    text = PENDULUM
    for name, own in names.items():
        text = text.replace(f'"{name}"', f'"{own}"')
    np.savez(tmp_path / "run.npz", t=t, angles=np.zeros((11, 2)), forces=np.zeros((11, 1)))
    path = tmp_path / "cart.toml"
    path.write_text(text)
    job = Job.read(path)
    assert job.folder == tmp_path / "cart" and not job.held_out and len(job.fit) == 1
    mass, damping, both = (job.unknowns[k] for k in ("mass", "damping", "both"))
    assert mass.bounds == (0.01, 1.0) and mass.index == model.nb - 1
    assert damping.index == 1 and both.index.tolist() == [0, 1]
    assert job.unknowns["pole"] == Inertia(names["pole"]) and job.unknowns["level"] == Tilt()
    np.testing.assert_array_equal(job.setup.controller.kp, [3.0])
    assert job.setup.delay == 0.012 and job.grid.period == 0.02 and job.grid.substeps == 2
    assert job.grid.longest_delay == 3  # of 36 ms, and one
    path.write_text(text.replace("substeps = 2\n", ""))
    assert Job.read(path).grid == Grid(0.02, 0, longest_delay=3)  # `identify` checks the steps
    path.write_text(text.replace("substeps = 2\n", "").replace("period = 0.02\n", ""))
    assert Job.read(path).grid == Grid(0.02, 0, longest_delay=3)  # the finest clock


def test_the_command_says_what_was_found(tmp_path, monkeypatch):
    """Of a fit that did not converge: its table, verdict and files, and exit code 1."""
    path = write_example(tmp_path)
    J = np.random.default_rng(0).normal(size=(40, 1))
    said = estimates(["mass"], np.array([0.7]), J, 0.01, dof=39)
    found = types.SimpleNamespace(
        values={"mass": 0.7}, guess={"mass": 0.5}, estimates=said, evaluations=100,
        status=Status.BUDGET, success=False,
    )  # fmt: skip
    diagnosis = types.SimpleNamespace(causes=["the sign of joint elbow"])
    files = {"report": tmp_path / "report.html"}
    results = Results(found, None, diagnosis, files, ("arm-found.xml is new",))
    monkeypatch.setattr(Job, "run", lambda job, **how: results)
    text = run(path, code=1).stdout
    interval = said.interval("mass")
    parts = (
        "not converged in 100 evaluations", "mass", f"{interval.low:.5g}", "report.html",
        "no recording was held out", "the sign of joint elbow", "arm-found.xml is new",
    )  # fmt: skip
    for part in parts:
        assert part in text


def test_a_robot_whose_file_cannot_say_it_gets_a_new_one(tmp_path):
    """Gravity that is tilted has no place in a URDF."""
    urdf = """<robot name="r"><link name="base"/><link name="arm"><inertial>
      <origin xyz="0 0 -0.1"/><mass value="1"/>
      <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="j" type="continuous"><parent link="base"/><child link="arm"/>
      <axis xyz="0 1 0"/></joint></robot>"""
    (tmp_path / "r.urdf").write_text(urdf)
    model = rb.load(tmp_path / "r.urdf")
    job = Job(str(tmp_path / "r.urdf"), None, (), (), {}, None, {}, tmp_path)
    heavier = model.replace(bodies=model.bodies.replace(mass=2 * model.bodies.mass))
    path, note = job._robot(heavier)
    assert path.name == "r-found.urdf" and not note
    tilted = heavier.replace(gravity=np.array([0.5, 0.0, -9.8]))
    written, note = job._robot(tilted)
    assert written.name == "r-found.xml" and "r-found.xml is new" in note and "gravity" in note
    np.testing.assert_allclose(rb.load(written).gravity, [0.5, 0.0, -9.8])
