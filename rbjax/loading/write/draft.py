"""An MJCF file in the making: its elements by body and joint, and what it cannot say."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rbjax.errors import listed
from rbjax.model import WORLD, Model

_SHOWN = 8  # names listed before "and N more"
_USUAL = {("pos", "0 0 0"), ("quat", "1 0 0 0"), ("gear", "1")}


@dataclass
class Draft:
    """The file of a model: `root` and its sections, the elements of bodies and of joints by their
    index, the names of sites, and notes on what is written otherwise or not at all."""

    model: Model
    root: ET.Element
    option: ET.Element
    world: ET.Element
    tendon: ET.Element
    equality: ET.Element
    actuator: ET.Element
    bodies: list[ET.Element] = field(default_factory=list)
    joints: list[ET.Element] = field(default_factory=list)
    sites: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, model: Model) -> Draft:
        """The empty file of a model."""
        root = ET.Element("mujoco", model="rbjax")
        # the numbers are final: no inertia is to be computed from a shape
        ET.SubElement(root, "compiler", angle="radian", inertiafromgeom="false")
        return cls(
            model,
            root,
            option=ET.SubElement(root, "option"),
            world=ET.SubElement(root, "worldbody"),
            tendon=ET.SubElement(root, "tendon"),
            equality=ET.SubElement(root, "equality"),
            actuator=ET.SubElement(root, "actuator"),
        )

    def body(self, index: int) -> ET.Element:
        """The element of a body, or of the world."""
        return self.world if index == WORLD else self.bodies[index]

    def add(self, body: int, tag: str, **attributes: str) -> ET.Element:
        """A joint, site or geom of a body, before the bodies that it carries."""
        owner, element = self.body(body), ET.Element(tag, unusual(**attributes))
        owner.insert(next((i for i, x in enumerate(owner) if x.tag == "body"), len(owner)), element)
        return element

    def joint(self, index: int) -> str:
        """The name under which a joint is written."""
        return self.joints[index].get("name", "")

    def note(self, what: str, names: Iterable[str] = ()) -> None:
        """Say that something is not written as the model has it; once for each text."""
        some = list(names)
        text = f"{what} ({listed(some, _SHOWN)})" if some else what
        if text not in self.notes:
            self.notes.append(text)


def free_bodies(model: Model) -> set[int]:
    """The bodies on free joints, whose frame a file gives as the start of the joint."""
    top = model.topology
    kinds = zip(top.joint_bodies, top.joint_kinds, strict=True)
    return {body for body, kind in kinds if kind == "free"}


def unusual(**attributes: str) -> dict[str, str]:
    """The attributes without those that have MJCF's own value."""
    return {key: x for key, x in attributes.items() if (key, x) not in _USUAL}


def text(x: Any) -> str:
    """Numbers as MJCF writes them: the shortest decimals that are the same number in their dtype.

    >>> text(np.array([1.0, 0.1, -np.inf])), text(np.float32(0.1))
    ('1 0.1 -inf', '0.1')
    """
    return " ".join(str(n).removesuffix(".0") for n in np.ravel(np.asarray(x)))


def unique(names: Sequence[str], taken: Iterable[str] = ()) -> list[str]:
    """The names, with a number behind those that came before.

    >>> unique(["a", "b", "a"])
    ['a', 'b', 'a_2']
    """
    seen, out = set(taken), []
    for name in names:
        new, n = name, 1
        while new in seen:
            n += 1
            new = f"{name}_{n}"
        seen.add(new)
        out.append(new)
    return out
