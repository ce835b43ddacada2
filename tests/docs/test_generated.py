"""Registries, the command line and robot files: the pages say what the code has."""

import re

import pytest

import rbjax as rb
from docs.generate.reference import command_line, registries
from tests.docs.pages import DOCS, ROOT


@pytest.fixture(scope="module")
def lists() -> dict[str, str]:
    return registries.pages(ROOT)


REGISTRIES = {
    "joints": rb.joints.kinds, "constraints": rb.constraints.kinds,
    "formulations": rb.constraints.formulations, "contact_laws": rb.contact.laws,
    "sensors": rb.sensors.kinds, "solvers": rb.solvers.all, "wheels": rb.wheeled.kinds,
    "tasks": rb.envs.tasks, "control_methods": rb.control.methods,
    "planning": rb.planning.methods, "attitudes": rb.rotations.representations,
    "scenes": rb.scenes,
}  # fmt: skip


@pytest.mark.parametrize("name", REGISTRIES)
def test_every_entry_of_a_registry_has_a_row(name, lists):
    page = lists[f"reference/registries/{name}.md"]
    rows = "\n".join(line for line in page.splitlines() if line.startswith("|"))
    missing = [entry for entry in REGISTRIES[name]() if f"`{entry}`" not in rows]
    assert not missing


def test_every_public_force_element_has_a_row(lists):
    page = lists["reference/registries/forces.md"]
    rooms = (rb.forces, rb.contact, rb.flexible, rb.flexible.modal, rb.wheeled)
    elements = {
        cls.__name__
        for room in rooms
        for cls in registries.classes(room)
        if issubclass(cls, rb.forces.Element) and cls is not rb.forces.Element
    }
    assert len(elements) > 10
    assert not [name for name in elements if f"`{name}`" not in page]


def test_rows_have_a_text(lists):
    for path, page in lists.items():
        assert "partial(" not in page and "<function" not in page, path


def test_every_command_and_option_is_on_the_page():
    page = command_line.pages(ROOT)["reference/command_line.md"]
    assert len(command_line.commands()) >= 9
    for name in command_line.commands():
        assert f"## rbjax {name}\n" in page
    assert "--floating-base" in page and "Usage: rbjax info" in page
    assert "…" not in page.split("## rbjax train")[0], "a text is cut"


def test_entries_of_what_is_left_out_are_those_of_the_loader():
    page = (DOCS / "reference" / "files.md").read_text()
    rows = re.findall(r"^\|[^|]*\|([^|]*)\|$", page.split("Left out", 1)[1], re.MULTILINE)
    entries = {entry for row in rows for entry in re.findall(r"`([^`]+)`", row)}
    folder = ROOT / "rbjax" / "loading"
    sources = "".join(p.read_text() for p in folder.rglob("*.py"))
    options = {"option", "size", "compiler"}  # elements of a URDF's extension
    calls = {x for x in entries if "rb." in x or "<" in x}
    assert len(entries) > 20
    missing = {x for x in entries - options - calls if x not in sources and x not in GENERAL}
    assert not missing


#: entries whose text the loader composes
GENERAL = {"adhesion", "adhesion of contact pairs", "surface velocity"}


def test_the_sensors_that_are_not_read_are_named():
    import mujoco

    from rbjax.loading.mjcf.sensors import _READERS

    kinds = set()
    for i in range(100):
        try:
            kinds.add(mujoco.mjtSensor(i).name.removeprefix("mjSENS_").lower())
        except ValueError:
            continue
    page = (DOCS / "reference" / "files.md").read_text()
    row = next(line for line in page.splitlines() if line.startswith("| sensors `user`"))
    assert kinds - set(_READERS) == set(re.findall(r"`(\w+)`", row.split("|")[1]))
