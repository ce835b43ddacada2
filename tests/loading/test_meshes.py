"""Meshes whose file is absent or somewhere else, against what MuJoCo makes of a complete file."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

import rbjax as rb
from tests.robots import load_quietly

INERTIAL = '<inertial pos="0 0 0.1" mass="2" diaginertia="0.1 0.2 0.25"/>'
TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def text(compiler: str = "", file: str = "t.obj", inertial: str = INERTIAL, geom: str = "") -> str:
    return f"""<mujoco><compiler {compiler}/><asset><mesh name="t" file="{file}"/></asset>
        <worldbody>
        <body name="heavy"><joint/>{inertial}<geom type="mesh" mesh="t" {geom}/></body>
        </worldbody></mujoco>"""


@pytest.fixture(autouse=True)
def _in_a_folder_with_a_mesh(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "t.obj").write_text(TETRAHEDRON)
    monkeypatch.chdir(tmp_path)


NEEDED = [
    {"inertial": ""},
    {"compiler": 'inertiafromgeom="true"'},
    {"compiler": 'inertiafromgeom="true" strippath="true"', "file": "x/gone.obj"},
]


@pytest.mark.parametrize("case", NEEDED)
def test_a_mesh_that_gives_the_mass_is_needed(case: dict) -> None:
    with pytest.raises(
        rb.ModelError, match=r"'heavy'.*'t'.*'gone.obj' is missing.*<inertial>"
    ) as e:
        rb.load(text(**{"file": "gone.obj"} | case))
    assert ("inertiafromgeom='auto'" in str(e.value)) == ("compiler" in case)


OUT_OF_RANGE = {"compiler": 'inertiafromgeom="true" inertiagrouprange="0 1"', "geom": 'group="2"'}


@pytest.mark.parametrize(
    "case", [{}, {"compiler": 'inertiafromgeom="false"'}, OUT_OF_RANGE,
             {"file": "..\\gone.stl"}]
)  # fmt: skip
def test_a_mesh_that_is_only_seen_is_not(case: dict) -> None:
    model = load_quietly(text(**{"file": "gone.obj"} | case))
    np.testing.assert_array_equal(model.bodies.mass, [2.0])


FOUND = [
    {"file": "parts/t.obj"},
    {"compiler": 'meshdir="parts"'},
    {"compiler": 'meshdir="parts" strippath="true"', "file": "somewhere/else/t.obj"},
]


@pytest.mark.parametrize("case", FOUND)
def test_a_mesh_is_found_where_mujoco_finds_it(case: dict) -> None:
    heavy = text(**case, inertial="")
    want = mujoco.MjModel.from_xml_string(heavy).body_mass[1:]
    np.testing.assert_array_equal(load_quietly(heavy).bodies.mass, want)


def test_attached_models_have_folders_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "child.xml").write_text(text('meshdir="parts"', inertial=""))
    whole = tmp_path / "whole.xml"
    whole.write_text("""<mujoco><asset><model name="child" file="child.xml"/></asset><worldbody>
        <attach model="child" body="heavy" prefix="x_"/></worldbody></mujoco>""")
    want = mujoco.MjModel.from_xml_path(str(whole)).body_mass[1:]
    np.testing.assert_array_equal(load_quietly(whole).bodies.mass, want)


def test_a_mesh_in_memory_is_there() -> None:
    spec = mujoco.MjSpec.from_string(text(file="memory.obj", inertial=""))
    spec.assets = {"memory.obj": TETRAHEDRON}
    np.testing.assert_array_equal(load_quietly(spec).bodies.mass, spec.compile().body_mass[1:])


def test_the_callers_spec_stays_as_it_was() -> None:
    spec = mujoco.MjSpec.from_string(text(file="gone.obj"))
    before = len(spec.geoms), len(spec.meshes)
    load_quietly(spec)
    assert (len(spec.geoms), len(spec.meshes)) == before == (1, 1)
