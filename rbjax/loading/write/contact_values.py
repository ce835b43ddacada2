"""Values of contacts, limits and friction loss in the user's own file, for `write_back`."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from rbjax.loading.write.contacts import DOF_LEAVES, JOINT_LEAVES, PAIR_LEAVES, rubs
from rbjax.loading.write.draft import text
from rbjax.model import Model
from rbjax.model.geoms import LEAVES

_CLOSE = 1e-12  # relative change below which a number is not written


def write_changed(
    root: ET.Element,
    sections: Sequence[ET.Element],
    joints: Sequence[ET.Element],
    model: Model,
    before: Model,
) -> None:
    """Write the values of `model.solver` and `model.geoms` that differ from those of `before`.

    sections, joints: the elements of the world and bodies, and of the joints, in order.
    """
    own: Any = model.solver
    was: Any = before.solver
    if own is not None:
        if differs(own.impratio, was.impratio):
            child(root, "option").set("impratio", text(own.impratio))
        if len(joints) == len(model.joint_names):
            for j, (joint, start) in enumerate(zip(joints, model.topology.joint_v, strict=True)):
                _write_joint(joint, own, was, j, start, friction=not rubs(model))
    geoms: Any = model.geoms
    old: Any = before.geoms
    if geoms is None:
        return
    elements = [x for section in sections for x in children(section, "geom")]
    if len(elements) == len(old.names):
        _write_rows(elements, geoms, old, {key: key for key in LEAVES})
    pairs = [x for section in root.iter("contact") for x in section.findall("pair")]
    if len(pairs) == len(geoms.pair_condim):
        _write_rows(pairs, geoms, old, {key: f"pair_{key}" for key in PAIR_LEAVES})


def _write_joint(
    joint: ET.Element, own: Any, was: Any, index: int, dof: int, *, friction: bool
) -> None:
    """Write the attributes of one joint whose values in `own` and `was` differ."""
    for leaves, at in ((JOINT_LEAVES, index), (DOF_LEAVES, dof)):
        for key, (name, _) in leaves.items():
            new = getattr(own, name)[at]
            if (friction or key != "frictionloss") and differs(new, getattr(was, name)[at]):
                if joint.tag == "freejoint":  # which has no such attributes
                    joint.tag = "joint"
                    joint.set("type", "free")
                joint.set(key, text(new))


def _write_rows(elements: Sequence[ET.Element], own: Any, old: Any, names: dict[str, str]) -> None:
    """Write the rows in which `own` and `old` differ, as attributes of their XML elements.

    names: attribute -> name of the array.
    """
    for key, name in names.items():
        for element, new, was in zip(elements, getattr(own, name), getattr(old, name), strict=True):
            if differs(new, was):
                element.set(key, text(new))


def contact_leaves(model: Model, again: Model) -> Iterator[tuple[str, Any, Any]]:
    """Iterate over (name, value, value read back) of the contact parameters that a written file
    must reproduce. again: the model that was read from the file."""
    if model.geoms is not None:
        names = ["size", "position", *LEAVES, *(f"pair_{key}" for key in PAIR_LEAVES)]
        for name in names:
            yield f"geoms.{name}", getattr(model.geoms, name), getattr(again.geoms, name)
    if model.solver is not None:
        names = [name for name, _ in (*JOINT_LEAVES.values(), *DOF_LEAVES.values())]
        for name in ("impratio", *names):
            if not (name == "frictionloss" and rubs(model)):
                yield f"solver.{name}", getattr(model.solver, name), getattr(again.solver, name)


def children(element: ET.Element, *tags: str) -> list[ET.Element]:
    """List the children of a body with one of the tags, including those within frames."""
    found = []
    for x in element:
        if x.tag in tags:
            found.append(x)
        elif x.tag == "frame":
            found += children(x, *tags)
    return found


def child(element: ET.Element, tag: str) -> ET.Element:
    """Return the first child with a tag; add it if there is none."""
    found = element.find(tag)
    return ET.SubElement(element, tag) if found is None else found


def differs(a: Any, b: Any) -> bool:
    """Return whether numbers differ by more than rounding."""
    a, b = np.asarray(a), np.asarray(b)
    size = float(np.abs(b).max(initial=0.0))
    return bool(np.abs(a - b).max(initial=0.0) > _CLOSE * size)
