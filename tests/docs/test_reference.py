"""Every public name has an entry in the reference, and a sentence there."""

import pkgutil

import pytest

import rbjax as rb
from docs.generate.reference import pages as reference
from docs.generate.reference import rooms
from tests.docs.pages import ROOT


def test_every_public_name_has_an_entry():
    pages = reference.pages(ROOT)
    text = "\n".join(pages.values())
    links = rooms.links()
    missing = []
    for path in sorted(rooms.everything()):
        home = links.get(path)
        if home is None:  # a room or a module: it has a page or a section
            name = path.removeprefix("rbjax.")
            found = reference.path(name) in pages or f"{{#{path}}}" in text
        else:
            found = f"\n::: {home}\n" in text or f"{{#{home}}}" in text
        if not found:
            missing.append(path)
    assert len(links) > 1000 and not missing


def test_rooms_of_the_reference_are_all_public_rooms():
    tops = {m.name for m in pkgutil.iter_modules(rb.__path__) if m.ispkg}
    assert set(rooms.outer_rooms()) == tops - set(rooms.COMMAND_LINE) - {"motion"}
    assert not hasattr(rooms.package("motion"), "__all__")


@pytest.mark.parametrize("room", rooms.all_rooms())
def test_every_entry_has_a_sentence(room):
    without = [e.path for e in rooms.entries(room) if e.kind == "object" and not e.summary]
    assert not without


@pytest.mark.parametrize("room", rooms.all_rooms())
def test_groups_have_every_name_once(room):
    grouped = [e.path for found in rooms.groups(room).values() for e in found]
    assert len(grouped) == len(set(grouped))
    rest = {e.path for e in rooms.entries(room)} - set(grouped)
    assert all(room == "" and rooms.inner_rooms(p.removeprefix("rbjax.")) is not None for p in rest)


def test_results_without_a_public_name_are_described_once_after_their_function():
    text = "\n".join(reference.pages(ROOT).values())
    found = {path: cls for paths in rooms.results().values() for path, cls in paths.items()}
    assert "rbjax.control.linear.algebraic_riccati.Regulator" in found
    for path, cls in found.items():
        assert text.count(f"\n::: {path}\n") == 1, path
        assert rooms.first_sentence(cls.__doc__ or ""), path
