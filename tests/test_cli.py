"""The command line: output, files, exit codes, one-sentence errors."""

import functools
import json
import re
import sys
from pathlib import Path

import jax
import numpy as np
import pytest
from typer.testing import CliRunner

import rbjax as rb
from rbjax.cli import app
from rbjax.demo.report import ReportSection


def run(*args: str, code: int = 0):
    result = CliRunner().invoke(app, list(args))
    assert result.exit_code == code, (result.output, result.exception)
    return result


def test_version() -> None:
    assert run("--version").stdout == f"rbjax {rb.__version__}\n"
    text = run("--help").output
    assert "--version" in text and "Differentiable rigid-body dynamics" in text and "bench" in text


def test_the_demo_says_each_step_where_there_is_no_terminal(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def part(folder, say, **options):
        say("first [of two]")
        say("second")
        return ReportSection("Part", ("Words.",))

    monkeypatch.setattr("rbjax.demo.run.PARTS", {"motion": (part, 1.0)})
    result = run("demo", "--out", str(tmp_path))
    assert re.fullmatch(r" *\d+ s  first \[of two\]\n *\d+ s  second\n", result.stderr)
    assert "done" in result.stdout and (tmp_path / "report.html").exists()


def test_the_demo_runs_its_long_parts_if_asked(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def part(folder, say, name):
        say(name)
        return ReportSection(name, ("Words.",))

    parts = {n: (functools.partial(part, name=n), 1.0) for n in ("motion", "loops")}
    monkeypatch.setattr("rbjax.demo.run.PARTS", parts)
    assert "loops" not in run("demo", "--out", str(tmp_path)).stderr
    text = run("demo", "--all", "--out", str(tmp_path)).stderr
    assert "motion" in text and "loops" in text


def test_info_says_what_a_robot_is() -> None:
    text = run("info", "cart_pole").output
    assert "pole" in text and "hinge" in text and "forward dynamics" in text


def test_info_as_json() -> None:
    found = json.loads(run("info", "arm7", "--json").stdout)
    assert found["nv"] == 7 and len(found["joint_names"]) == 7
    assert 0 < found["operations"]["forward dynamics (ABA)"]["total"] < 10_000


def test_info_lists_what_is_left_out(tmp_path: Path) -> None:
    file = tmp_path / "limited.xml"
    joint = '<joint name="j"/>'
    file.write_text(
        f"<mujoco><compiler angle='radian'/><worldbody><body>{joint}"
        "<geom size='0.1'/></body></worldbody>"
        "<sensor><user name='g' dim='1'/></sensor></mujoco>"
    )
    found = json.loads(run("info", str(file), "--json").stdout)["dropped"]
    assert found == ["sensors of the kind user (g)"]


def test_validate_as_json() -> None:
    args = ("--json", "--states", "3", "--no-mjx", "--no-gradient")
    found = json.loads(run("validate", "pendulum", *args).stdout)
    assert found["success"] and found["states"] == 3
    assert "within tolerance" in run("validate", "pendulum", *args[1:]).stdout


def test_bench_times_both_engines() -> None:
    text = run("bench", "pendulum", "--batch", "4").stdout
    assert "MuJoCo C, f64" in text and "rbjax, f32" in text and "batch 4" in text
    found = json.loads(run("bench", "pendulum", "--batch", "4", "--json").stdout)
    assert len(found["us"]) == 3 and min(found["us"].values()) > 0


def test_simulate_writes_files(tmp_path: Path) -> None:
    data, picture = tmp_path / "path.npz", tmp_path / "path.png"
    args = ("--seconds", "0.2", "--solver", "rk4", "--out", str(data), "--plot", str(picture))
    result = run("simulate", "pendulum", "--keyframe", "horizontal", *args, "--json")
    found = json.loads(result.stdout)
    assert found["success"] and np.load(data)["q"].shape == (found["states"], 1)
    assert picture.read_bytes().startswith(b"\x89PNG")
    args = ("--seconds", "0.2", "--solver", "rk4", "--keyframe", "horizontal")
    assert "energy [" in run("simulate", "pendulum", *args).stdout


@pytest.mark.parametrize("suffix", ["gif", "html"])
def test_simulate_writes_a_video(suffix: str, tmp_path: Path) -> None:
    video = tmp_path / f"swing.{suffix}"
    args = ("--seconds", "0.2", "--dt", "0.01", "--fps", "20", "--video", str(video), "--json")
    found = json.loads(run("simulate", "pendulum", "--solver", "rk4", *args).stdout)
    assert found["states"] == 21
    assert video.read_bytes().startswith(b"GIF89a" if suffix == "gif" else b"<!doctype html>")


@pytest.mark.parametrize(
    ("args", "says"),
    [
        (("info", "nothing"), "unknown scene 'nothing'"),
        (("info", "nowhere.xml"), "no such file"),
        (("simulate", "pendulum", "--solver", "magic"), "expected one of tsit5"),
        (("simulate", "pendulum", "--keyframe", "magic"), "unknown keyframe 'magic'"),
        (("simulate", "pendulum", "--seconds", "0"), "expected more than 0"),
        (("simulate", "pendulum", "--video", "swing.avi"), "ends in .gif, .mp4, .html"),
        (("validate", "nothing"), "unknown scene"),
    ],
)
def test_bad_input_is_one_sentence(args: tuple[str, ...], says: str) -> None:
    result = run(*args, code=2)
    assert says in result.stderr
    assert "Traceback" not in result.output + result.stderr


def test_a_file_that_does_not_parse(tmp_path: Path) -> None:
    file = tmp_path / "broken.xml"
    file.write_text("<mujoco><worldbody>")
    assert "broken.xml" in run("info", str(file), code=2).stderr


def test_view_writes_a_page_of_a_trajectory(tmp_path: Path) -> None:
    saved, page = tmp_path / "swing.npz", tmp_path / "swing.html"
    args = ("--seconds", "0.1", "--solver", "rk4", "--dt", "0.01", "--out", str(saved))
    run("simulate", "double_pendulum", *args, "--json")
    assert "wrote" in run("view", str(saved), "--out", str(page)).stdout
    assert '"frames": 3' in page.read_text()


def test_view_of_nothing_is_a_sentence(tmp_path: Path) -> None:
    args = ("--out", str(tmp_path / "a.html"))
    assert "cart_pole_balance" in run("view", "cart_pole_balanse", *args, code=2).stderr
    assert ".gif, .mp4, .html" in run("view", "pendulum", "--out", "a.txt", code=2).stderr


def test_view_without_viser_says_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'rbjax[viewer]'" in run("view", "pendulum", code=2).stderr


@pytest.mark.slow
def test_play_draws_a_checkpoint(tmp_path: Path) -> None:
    pytest.importorskip("orbax.checkpoint", reason="checkpoints are written by orbax")
    from rbjax.envs import learning

    with jax.enable_x64(False):
        env = rb.envs.make("cart_pole_balance")
        policy = learning.new_policy(env, jax.random.key(0), (8,))
        saved = learning.save_policy(tmp_path / "policy", policy, "cart_pole_balance")
    page = tmp_path / "policy.html"
    run("play", str(saved), "--samples", "3", "--seconds", "0.2", "--out", str(page))
    assert '"samples": 3' in page.read_text()
    assert "rbjax:" in run("play", str(tmp_path), "--out", str(page), code=2).stderr
