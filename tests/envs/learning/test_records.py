"""Records of trainings: table, chart, checkpoint, and `train`, which writes them."""

import csv
import json
import math

import jax
import numpy as np
import pytest

import rbjax as rb
from rbjax.envs import Environment
from rbjax.envs.learning import Monitor, load_policy, new_policy, save_policy, train
from rbjax.envs.learning.report import _sentence, write_table
from rbjax.errors import InputError
from tests.envs.learning.pole import KEY, environment


@pytest.fixture
def pole():
    """The test's task in the registry."""
    from rbjax.envs import registry

    registry._TASKS.pop("pole_of_tests", None)
    rb.envs.register("pole_of_tests")(lambda episode=5: environment(episode=episode).task)
    yield "pole_of_tests"
    del registry._TASKS["pole_of_tests"]


def test_a_table_and_a_chart(tmp_path):
    with Monitor("pole", 300, tmp_path / "new", show=False) as monitor:
        monitor(100, {"reward": math.nan})
        monitor(200, {"reward": 2.0, "reward_std": 0.5})
    rows = list(csv.DictReader((tmp_path / "new" / "table.csv").read_text().splitlines()))
    assert [row["steps"] for row in rows] == ["100", "200"]
    assert rows[0]["reward_std"] == "" and rows[1]["reward_std"] == "0.5"
    assert monitor.rows[1]["seconds"] > monitor.rows[0]["seconds"] > 0
    chart = (tmp_path / "new" / "chart.png").read_bytes()
    assert chart[:4] == b"\x89PNG" and len(chart) > 5000


def test_progress_says_the_time_left(capsys):
    text = _sentence({"steps": 1000, "steps_per_second": 500.0, "reward": 2.5}, 4000)
    assert text == "1,000 of 4,000 steps, reward 2.5, 500 a second, 6 s left"
    with Monitor("pole", 300) as monitor:
        monitor(100, {"reward": 1.0})
    assert "pole: 100 of 300 steps, reward 1" in capsys.readouterr().err.replace("\n", " ")


def test_a_table_of_different_rows(tmp_path):
    write_table([{"a": 1}, {"b": 2}], tmp_path / "t.csv")
    assert (tmp_path / "t.csv").read_text().split() == ["a,b", "1,", ",2"]


@pytest.mark.parametrize("more", [{}, {"std": None}, {"normalise": False}])
def test_a_policy_comes_back(tmp_path, pole, more):
    pytest.importorskip("orbax.checkpoint")
    policy = new_policy(environment(), KEY, (3, 2), **more)
    save_policy(tmp_path, policy, pole, {"episode": 7}, {"rate": np.float32(0.5)})
    save_policy(tmp_path, policy, pole, {"episode": 7}, {"rate": np.float32(0.5)})  # again
    env, back = load_policy(tmp_path)
    assert env.episode == 7 and jax.tree.structure(back) == jax.tree.structure(policy)
    assert all((a == b).all() for a, b in zip(*map(jax.tree.leaves, (policy, back)), strict=True))
    assert json.loads((tmp_path / "policy.json").read_text())["settings"] == {"rate": 0.5}


def test_a_training_leaves_a_folder(tmp_path, pole):
    pytest.importorskip("orbax.checkpoint")
    found = train(
        pole, "shac", steps=48, out=tmp_path, progress=False, options={"episode": 6}, batch=4,
        horizon=3, hidden=(3,), reports=2,
    )  # fmt: skip
    assert found.rewards.shape == (4,)
    assert len(list(csv.DictReader((tmp_path / "table.csv").read_text().splitlines()))) == 2
    assert (tmp_path / "chart.png").is_file()
    env, policy = load_policy(tmp_path)
    obs, _ = env.reset(KEY)
    assert env.episode == 6 and (policy(obs) == found.policy(obs)).all()


def test_a_checkpoint_has_the_options_of_an_environment(tmp_path):
    """The sparse reward comes back; an environment that `make` did not make is refused."""
    pytest.importorskip("orbax.checkpoint")
    small = {"steps": 4, "progress": False, "batch": 2, "horizon": 2, "hidden": (3,), "reports": 1}
    env = rb.envs.make("cart_pole_balance", sparse=True)
    train(env, "shac", out=tmp_path, **small)
    assert json.loads((tmp_path / "policy.json").read_text())["options"] == {"sparse": True}
    back, _ = load_policy(tmp_path)
    assert (back.name, back.options) == ("cart_pole_balance", {"sparse": True})
    with pytest.raises(InputError, match="not made by"):
        train(environment(), "shac", out=tmp_path, **small)
    with pytest.raises(InputError, match="not made by"):
        train(Environment(env.task), "shac", out=tmp_path, **small)


@pytest.mark.parametrize("stage", ["arrays", "head"])
def test_a_checkpoint_that_fails_leaves_the_earlier_one(tmp_path, pole, monkeypatch, stage):
    """A failure while the arrays are written, and one before policy.json is replaced."""
    pytest.importorskip("orbax.checkpoint")
    policy = new_policy(environment(), KEY, (3,))
    save_policy(tmp_path, policy, pole)

    class Full:
        def save(self, path, arrays):
            raise OSError("no space")

    def fail(self, target):
        raise OSError("no space")

    if stage == "arrays":
        monkeypatch.setattr("rbjax.envs.learning.checkpoint._orbax", lambda where: Full())
    else:
        monkeypatch.setattr("pathlib.Path.replace", fail)
    with pytest.raises(OSError, match="no space"):
        save_policy(tmp_path, new_policy(environment(), KEY, (9, 9)), pole)
    monkeypatch.undo()
    assert load_policy(tmp_path)[1].network.sizes == (4, 3, 1)
    save_policy(tmp_path, policy, pole)
    assert len(list(tmp_path.glob("parameters*"))) == 1 and not list(tmp_path.glob("*.new"))
    assert load_policy(tmp_path)[1].network.sizes == (4, 3, 1)


def test_the_command(tmp_path, pole, monkeypatch):
    """`rbjax train` calls `train` with its options, and says an error in one sentence."""
    from typer.testing import CliRunner

    from rbjax.cli import app

    seen = {}
    monkeypatch.setattr(
        "rbjax.envs.learning.train", lambda *args, **more: seen.update(more, args=args)
    )
    result = CliRunner().invoke(
        app, ["train", pole, "--algorithm", "shac", "--steps", "9", "--out", str(tmp_path)]
    )
    assert result.exit_code == 0 and "policy.json" in result.output
    assert seen["args"] == (pole, "shac") and seen["steps"] == 9 and seen["out"] == tmp_path
    monkeypatch.undo()
    result = CliRunner().invoke(app, ["train", "no_task"])
    assert result.exit_code == 2 and "no_task" in result.stderr
