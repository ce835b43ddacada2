"""Job files: bad ones are named, names resolve, sensors are fitted, the page has every key."""

from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from typer.testing import CliRunner

import rbjax as rb
from rbjax.cli import app
from rbjax.errors import InputError, UnknownName
from rbjax.sysid import Setup
from rbjax.sysid.jobs import job as jobs
from rbjax.sysid.jobs.example import CONFIGURATION, write_example
from rbjax.sysid.jobs.job import Job
from rbjax.sysid.jobs.keys import KEYS, KINDS, index_of

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "job_files.md"
ANGLE = '"shoulder angle" = { sensor = "q", joint = "shoulder", unit = "deg" }'
ELBOW = '"elbow angle" = { sensor = "q", joint = "elbow", unit = "deg", sign = -1 }'


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    return write_example(tmp_path_factory.mktemp("job"))


def read(example, old="", new="", text=CONFIGURATION):
    assert old in text
    path = example.with_name("try.toml")
    path.write_text(text.replace(old, new, 1))
    return Job.read(path)


# -- the page -------------------------------------------------------------------------------------


@pytest.mark.parametrize("table", KEYS)
def test_the_page_has_each_key_with_value_unit_default_and_meaning(table):
    lines = PAGE.read_text().splitlines()
    head = f"## [{table}]" if table else "## Head of the file"
    start = lines.index(head)
    end = next((k for k in range(start + 1, len(lines)) if lines[k].startswith("## ")), None)
    rows = [x for x in lines[start:end] if x.startswith("| `")]
    cells = [row.split(" | ") for row in rows if len(row.split(" | ")) == 5]
    due = {f"| `{key}`": KINDS[kind][1] for key, kind in KEYS[table].items()}
    assert {key: value for key, value, *_ in cells} == due  # and no key that does not exist
    assert all(meaning.removesuffix(" |").strip() for *_, meaning in cells)


def test_the_page_shows_the_example():
    assert CONFIGURATION.strip() in PAGE.read_text()


# -- names ----------------------------------------------------------------------------------------


def test_a_joint_that_does_not_exist_is_named(example):
    for name in ("sholder", "nope"):  # codespell:ignore
        with pytest.raises(UnknownName, match=rf"joint of a column of sensor q '{name}'.*'elbow'"):
            read(example, ANGLE, ANGLE.replace('"shoulder", ', f'"{name}", '))
    with pytest.raises(UnknownName, match="did you mean 'shoulder'"):
        read(example, ANGLE, ANGLE.replace('"shoulder", ', '"sholder", '))  # codespell:ignore
    with pytest.raises(UnknownName, match=r"actuator of a column of sensor ctrl 'hip'"):
        read(example, 'sensor = "ctrl", joint = "elbow"', 'sensor = "ctrl", joint = "hip"')
    with pytest.raises(InputError, match=r"shoulder angle.*give joint = "):
        read(example, ', joint = "shoulder", unit = "deg"', ', unit = "deg"')


def test_a_unit_that_the_joint_cannot_have_is_named(example):
    with pytest.raises(UnknownName, match=r"unit of the hinge elbow in sensor q 'mm'.*'deg'"):
        read(example, ELBOW, ELBOW.replace("deg", "mm"))
    with pytest.raises(UnknownName, match="unit of sensor q 'rpm'"):
        read(example, ELBOW, ELBOW.replace("deg", "rpm"))


def test_columns_go_to_their_joints_in_any_order(example):
    text = CONFIGURATION.replace(ANGLE, "@").replace(ELBOW, ANGLE).replace("@", ELBOW)
    a, b = read(example).fit[0], read(example, text=text).fit[0]
    assert b["q"].names == ("elbow", "shoulder")
    np.testing.assert_array_equal(a["q"].values, b["q"].values[:, ::-1])


def test_noise_is_of_all_columns_of_a_sensor_or_of_none(example):
    noisy = ANGLE.replace(" }", ", noise = 0.1 }")
    with pytest.raises(InputError, match="some columns of q state their noise and elbow does not"):
        read(example, ANGLE, noisy)
    other = ELBOW.replace(" }", ", noise = 0.2 }")
    both = CONFIGURATION.replace(ANGLE, noisy).replace(ELBOW, other)
    assert read(example, text=both).fit[0]["q"].noise.tolist() == [0.1, 0.2]


TREE = """<mujoco><default><geom contype="0" conaffinity="0"/></default>
<worldbody><site name="s"/><body name="trunk"><joint name="lift" type="slide"/>
<geom size=".1"/><body name="head"><joint name="neck" type="ball"/><geom size=".1"/>
<body name="jaw"><joint name="bite"/><geom size=".1"/></body></body></body>
</worldbody><actuator><motor name="m" joint="bite"/></actuator></mujoco>"""


@pytest.fixture(scope="module")
def tree():
    model = rb.load(TREE)
    dry = rb.forces.JointFriction.of(model, ["bite", "lift"], jnp.array([0.3, 0.1]))
    return Setup.of(model.with_forces(dry))


@pytest.mark.parametrize(
    ("leaf", "index", "where"),
    [
        ("bodies.mass", "head", (1,)),
        ("bodies.mass", ["jaw", "trunk"], ([2, 0],)),
        ("bodies.mass", 2, (2,)),
        ("bodies.mass", -1, (-1,)),
        ("bodies.mass", [2, 0], ([2, 0],)),
        ("bodies.com", ["head", 2], (1, 2)),
        ("bodies.com", [["jaw", "head"], 2], ([2, 1], 2)),
        ("bodies.com", [[2, 1], 2], ([2, 1], 2)),
        ("bodies.com", ["jaw", "head"], ([2, 1],)),
        ("bodies.com", "jaw", (2,)),
        ("bodies.inertia", ["head", 1, 1], (1, 1, 1)),
        ("joints.damping", "lift", (0,)),
        ("joints.damping", "neck", ([1, 2, 3],)),
        ("joints.damping", "bite", (4,)),
        ("joints.armature", ["neck", "bite"], ([1, 2, 3, 4],)),
        ("joints.springref", "bite", (5,)),
        ("joints.stiffness", "bite", (2,)),
        ("actuators.gear", ["m", 0], (0, 0)),
        ("forces.0.coulomb", "bite", (0,)),  # in the element's order, not the model's
        ("forces.0.coulomb", "lift", (1,)),
        ("sensors.v.bias", "bite", (4,)),
        ("sensors.q.bias", "neck", ([1, 2, 3, 4],)),
        ("model.bodies.mass", "jaw", (2,)),
    ],
)
def test_names_resolve_within_indices(tree, leaf, index, where):
    value = rb.sysid.parameters.unknowns.leaf_of(tree, leaf)
    numbers = np.arange(value.size).reshape(value.shape)
    where = tuple(np.array(x) if isinstance(x, list) else x for x in where)
    np.testing.assert_array_equal(numbers[index_of(tree, leaf, index)], numbers[where])


@pytest.mark.parametrize(
    ("leaf", "index", "error"),
    [
        ("bodies.mass", "hed", "index of bodies.mass 'hed'.*did you mean 'head'"),
        ("bodies.mass", ["head", 2], "a place on 2 axes, expected one on 1"),
        ("bodies.mass", 3, "out of bounds.*has shape"),
        ("bodies.mass", ["head", "head"], "an entry twice"),
        ("bodies.com", ["head", 3], "out of bounds"),
        ("bodies.com", [["head"], ["z"]], "later axis, expected integers"),
        ("gravity", "z", "entries have no names; expected integers from 0 to 2"),
        ("forces.0.coulomb", "neck", "index of forces.0.coulomb 'neck'; .*'bite', 'lift'"),
        ("bodies.masss", 0, "did you mean 'bodies.mass'"),
        ("topology.nq", 0, "unknown leaf of Setup 'topology.nq'"),
    ],
)
def test_indices_that_are_not_there_are_named(tree, leaf, index, error):
    with pytest.raises(rb.RbjaxError, match=error):
        index_of(tree, leaf, index)


# -- what a file can say --------------------------------------------------------------------------


def test_every_sensor_is_fitted(tmp_path):
    """A gyro, a pose, torques and currents of a file are sensors of the set-up."""
    (tmp_path / "arm.xml").write_text(TREE.replace("ball", "hinge").replace("</geom>", ""))
    t = np.arange(20) * 0.01
    arrays = {"q": 3, "tau": 3, "gyro": 3, "pose": 7, "i": 3, "ctrl": 1}
    np.savez(tmp_path / "run.npz", t=t, **{k: np.ones((20, n)) for k, n in arrays.items()})
    text = """model = "arm.xml"
[recordings]
fit = "run.npz"
[columns]
q = { sensor = "q" }
tau = { sensor = "tau", noise = 0.1 }
gyro = { sensor = "gyro:s", unit = "deg/s" }
pose = { sensor = "pose:jaw" }
i = { sensor = "current", unit = "mA" }
ctrl = { sensor = "ctrl" }
[sensors]
current = [0.1, 0.2, 0.3]
[unknowns]
mass = { leaf = "bodies.mass", index = "jaw", positive = true }
bias = { leaf = "sensors.gyro:s.bias", index = "z" }
motor = { leaf = "readings.current.constant", index = "bite", positive = true }
[options]
multiple_shooting = 0.05
"""
    path = tmp_path / "job.toml"
    path.write_text(text)
    job = Job.read(path)
    assert set(job.setup.sensors) == {"q", "v", "tau", "gyro:s", "pose:jaw", "current"}
    assert job.setup.readings["current"].constant.tolist() == [0.1, 0.2, 0.3]
    assert job.unknowns["bias"].index == 2 and job.unknowns["motor"].index == 2
    assert job.options == {"multiple_shooting": 0.05}
    path.write_text(text.replace("current = [0.1, 0.2, 0.3]", ""))
    with pytest.raises(InputError, match=r"current needs the torque constants.*\[sensors\]"):
        Job.read(path)
    path.write_text(text.replace('gyro:s", unit = "deg/s"', 'force:s"'))
    with pytest.raises(InputError, match="force:s is not one that a job file can simulate"):
        Job.read(path)
    path.write_text(text.replace("pose:jaw", "pose:jav"))
    with pytest.raises(UnknownName, match=r"body or site .* 'jav'.*did you mean 'jaw'"):
        Job.read(path)


def test_shooting_and_many_starts_reach_the_estimators(example, monkeypatch):
    class Called(Exception):
        pass

    def called(*_, **how):
        raise Called(how)

    monkeypatch.setattr(jobs, "identify", called)
    with pytest.raises(Called) as caught:
        read(
            example,
            "estimate_initial_state = true",
            'multiple_shooting = 0.5\nloss = "huber"\nmax_evaluations = 7',
        ).run()
    how = caught.value.args[0]
    assert (how["multiple_shooting"], how["loss"], how["max_evaluations"]) == (0.5, "huber", 7)
    monkeypatch.setattr(jobs, "many_starts", called)
    job = read(example, "estimate_initial_state = true", "many_starts = 5")
    with pytest.raises(Called) as caught:
        job.run()
    assert caught.value.args[0]["guesses"] == 5
    with pytest.raises(Called) as caught:  # what was found goes on
        job.run(resume=True)
    assert "guesses" not in caught.value.args[0]


@pytest.mark.slow
def test_many_starts_find_the_truth(example):
    job = read(
        example, "estimate_initial_state = true", "estimate_initial_state = true\nmany_starts = 4"
    )
    found = job.run().found
    assert abs(found.values["fore mass"] - 0.62) < 0.01


def test_results_lie_within_the_folder_of_the_file_or_where_the_command_says(example, tmp_path):
    for name in ("../out", "/tmp/out", "a/../../out"):
        with pytest.raises(InputError, match=r"lies outside of .*--out FOLDER"):
            read(example, 'folder = "found"', f'folder = "{name}"')
    path = example.with_name("try.toml")
    assert Job.read(path, folder=tmp_path / "elsewhere").folder == tmp_path / "elsewhere"
    assert read(example, 'folder = "found"', 'folder = "a/b"').folder == example.parent / "a" / "b"


def test_messages_keep_their_brackets(example):
    """`[options]` is text, not markup of the terminal."""
    path = example.with_name("try.toml")
    path.write_text(CONFIGURATION.replace("estimate_initial_state = true", "begin = true"))
    said = CliRunner().invoke(app, ["identify", str(path)])
    assert said.exit_code == 2 and "key of [options] 'begin'" in " ".join(said.stderr.split())
