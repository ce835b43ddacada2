"""Every part of the demo, small: it runs, finds the right numbers, writes pictures and a report."""

import re
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import pytest

from rbjax.demo import demo
from rbjax.demo.forces import forces
from rbjax.demo.identify import identify
from rbjax.demo.integrators import integrators
from rbjax.demo.joints import joints
from rbjax.demo.loops import loops
from rbjax.demo.motion import motion
from rbjax.demo.planning import planning
from rbjax.demo.report import Section
from rbjax.demo.swing_up import swing_up
from rbjax.demo.threads import threads
from rbjax.demo.validate import validate
from rbjax.demo.wheels import wheels


@pytest.fixture(autouse=True)
def _no_window() -> None:
    matplotlib.use("Agg")


def quiet(text: str) -> None:
    pass


def check(section: Section, folder: Path) -> None:
    assert section.text
    for name, caption in section.pictures:
        assert caption and (folder / name).stat().st_size > 5_000
    assert all(len(row) == len(section.columns) for row in section.rows)


def test_motion(tmp_path: Path) -> None:
    section = motion(tmp_path, quiet, batch=2, fan=4, seconds=0.1, scenes=("pendulum",))
    check(section, tmp_path)


def test_validation(tmp_path: Path) -> None:
    section = validate(tmp_path, quiet, scenes={"pendulum": True})
    check(section, tmp_path)
    assert section.rows[0][-1] == "yes"


def test_identification_finds_the_truth(tmp_path: Path) -> None:
    section = identify(tmp_path, quiet, steps=200)
    check(section, tmp_path)
    for name, _, estimate, truth, _ in section.rows:
        value, low, high = (float(x) for x in re.findall(r"-?[0-9.]+", estimate))
        assert low < value < high < low + 1, name
        assert abs(value - float(truth)) < high - low + 1e-3, name
    assert section.links[0][0] == "identification.html"
    assert "Found by themselves" in (tmp_path / "identification.html").read_text()


def test_swing_up_comes_up(tmp_path: Path) -> None:
    section = swing_up(tmp_path, quiet)
    check(section, tmp_path)
    values = {row[0]: float(row[1].split()[0]) for row in section.rows}
    assert abs(values["pole angle from upright"]) < 1 and abs(values["cart position"]) < 0.01
    assert values["largest force"] == 5.0
    assert values["MuJoCo C under the same forces, final difference"] < 1e-6
    assert abs(values["the same with feedback"]) < 10
    assert abs(values["pole angle from another start, open loop"]) > 20


def test_integrators_converge(tmp_path: Path) -> None:
    section = integrators(
        tmp_path, quiet, scenes=("double_pendulum",), batch=2, refined=(1,), mjx=False
    )
    check(section, tmp_path)
    error = {row[1]: float(row[4]) for row in section.rows}
    assert error["RK4"] < 1e-3 * error["semi-implicit Euler"]


def test_threads_are_counted(tmp_path: Path) -> None:
    section = threads(tmp_path, quiet, scenes=("pendulum", "cart_pole"))
    check(section, tmp_path)
    small, large = (int(row[1].replace(",", "")) for row in section.rows)
    assert 5 < small < large < 1000


def test_carts_swing_on_bent_rails(tmp_path: Path) -> None:
    section = joints(tmp_path, quiet, steps=50)
    assert (tmp_path / "joints.png").stat().st_size > 10_000
    assert all(float(lost) < 1e-6 for *_, lost in section.rows)


def test_a_loop_stays_closed(tmp_path: Path) -> None:
    section = loops(tmp_path, quiet, steps=200)
    assert (tmp_path / "loops.png").stat().st_size > 10_000
    gap = {row[0]: float(row[1]) for row in section.rows}
    assert gap["projected"] < 1e-14 and gap["multipliers"] < 1e-6


def test_forces_act(tmp_path: Path) -> None:
    section = forces(tmp_path, quiet, steps=200)
    check(section, tmp_path)
    lowest = {row[0]: float(row[1]) for row in section.rows}
    assert lowest["nothing"] < lowest["dry friction"] < lowest["a stop"] < -0.8


def test_the_report_holds_all(tmp_path: Path) -> None:
    parts: dict = dict.fromkeys(
        ("motion", "identify", "swing_up", "integrators", "forces", "joints", "loops", "wheels",
         "planning", "threads")
    )  # fmt: skip
    parts["validate"] = {"scenes": {"pendulum": False}}
    page = demo(tmp_path, say=quiet, options=parts)
    assert "<table>" in page.read_text()
    assert "| scene |" in (tmp_path / "report.md").read_text()
    assert jnp.ones(1).dtype == jnp.float64  # the caller's choice, as before


def test_wheels_lose_their_grip(tmp_path: Path) -> None:
    section = wheels(tmp_path, quiet, steps=200)
    check(section, tmp_path)
    speed = [float(row[1]) for row in section.rows]
    slides = [float(row[-1]) for row in section.rows]
    assert abs(speed[0] - 0.8) < 0.05 and speed == sorted(speed, reverse=True)
    assert slides == sorted(slides) and slides[0] < 0.1 < slides[-1]


def test_a_car_parks(tmp_path: Path) -> None:
    section = planning(tmp_path, quiet)
    check(section, tmp_path)
    plan, curve = section.rows
    assert plan[-1] == "yes" and float(plan[1]) > float(curve[1])
