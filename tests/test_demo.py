"""Every part of the demo, small: it runs, finds the right numbers, writes pictures and a report."""

import re
import threading
from pathlib import Path

import jax.numpy as jnp
import matplotlib
import pytest

from rbjax.demo import demo
from rbjax.demo.identify import identify
from rbjax.demo.integrators import integrators
from rbjax.demo.motion import motion
from rbjax.demo.notebooks import FOLDER, NOTEBOOKS, notebook
from rbjax.demo.report import ReportSection
from rbjax.demo.run import CONCURRENT, PARTS, _in_order
from rbjax.demo.validate import validate
from rbjax.errors import RbjaxError


@pytest.fixture(autouse=True)
def _no_window() -> None:
    matplotlib.use("Agg")


def quiet(text: str) -> None:
    pass


def check(section: ReportSection, folder: Path) -> None:
    assert section.text
    for name, caption in section.pictures:
        assert caption and (folder / name).stat().st_size > 5_000
    assert all(len(row) == len(section.columns) for row in section.rows)


def test_motion(tmp_path: Path) -> None:
    section = motion(tmp_path, quiet, batch=2, scenes=("cart_pole",))
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
    assert "Identifiable by themselves" in (tmp_path / "identification.html").read_text()


def test_integrators_converge(tmp_path: Path) -> None:
    section = integrators(
        tmp_path, quiet, scenes=("double_pendulum",), batch=2, refined=(1,), mjx=False
    )
    check(section, tmp_path)
    error = {row[1]: float(row[4]) for row in section.rows}
    assert error["RK4"] < 1e-3 * error["semi-implicit Euler"]


def test_the_report_holds_all(tmp_path: Path) -> None:
    parts: dict = dict.fromkeys(PARTS)
    parts["validate"] = {"scenes": {"pendulum": False}}
    page = demo(tmp_path, say=quiet, options=parts)
    assert "<table>" in page.read_text()
    assert "| scene |" in (tmp_path / "report.md").read_text()
    assert jnp.ones(1).dtype == jnp.float64  # the caller's choice, as before


def test_notebooks_run_beside_the_parts_that_measure_no_time() -> None:
    together = threading.Barrier(2, timeout=10)
    active: set[str] = set()

    def run(name: str) -> ReportSection:
        if name == "motion" or name == "integrators":
            assert not active & set(CONCURRENT)
        active.add(name)
        if name in ("validate", "forces"):
            together.wait()
        active.remove(name)
        return ReportSection(name, ("text",))

    order = ["motion", "validate", "identify", "integrators", *CONCURRENT]
    assert [section.title for section in _in_order(order, run)] == order
    assert [section.title for section in _in_order(["joints"], run)] == ["joints"]


def test_an_error_in_a_notebook_ends_the_demo() -> None:
    def run(name: str) -> ReportSection:
        if name == "forces":
            raise RbjaxError("no forces")
        return ReportSection(name, ("text",))

    with pytest.raises(RbjaxError, match="no forces"):
        _in_order(["validate", "forces"], run)


NOTEBOOK = """\
# %% [markdown]
# # Two lines
#
# A line rises,
# another falls.
#
# More.

# %%
import matplotlib.pyplot as plt

plt.plot([0, 1])

# %% [markdown]
# ## The other

# %%
plt.plot([1, 0])
print("drawn")
"""


def test_a_notebook_becomes_a_section(tmp_path: Path) -> None:
    (tmp_path / "lines.py").write_text(NOTEBOOK)
    section = notebook(tmp_path, quiet, name="lines", notebooks=tmp_path)
    check(section, tmp_path)
    assert section.title == "Two lines" and section.text == ("A line rises, another falls.",)
    assert section.pictures == (("lines_1.png", "Two lines"), ("lines_2.png", "The other"))


def test_a_notebook_that_fails_is_named(tmp_path: Path) -> None:
    (tmp_path / "wrong.py").write_text(NOTEBOOK + "\n# %%\n1 / 0\n")
    with pytest.raises(RbjaxError, match=r"wrong.py failed(?s:.*)ZeroDivisionError"):
        notebook(tmp_path, quiet, name="wrong", notebooks=tmp_path)


def test_the_notebooks_of_the_demo_exist() -> None:
    assert all((FOLDER / f"{name}.py").exists() for name in NOTEBOOKS)
    assert NOTEBOOKS.keys() < PARTS.keys()
