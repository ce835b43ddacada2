"""`rbjax identify`: the example, its files, going on, and errors that name what is wrong."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

import rbjax as rb
from rbjax.cli import app
from rbjax.sysid.job import Job
from rbjax.sysid.job_example import CONFIGURATION, TRUTH, write_example


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
        ("[unknowns]", "[unknowns", "is no TOML"),
        ('model = "arm.xml"', "", "has no model"),
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
