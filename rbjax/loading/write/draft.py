"""An MJCF file under construction: its XML elements, and notes on parts that it cannot express."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from rbjax.errors import listed
from rbjax.forces import Place, PointSpring
from rbjax.loading.mjcf.fields import ALIGNED
from rbjax.model import WORLD, Model

_USUAL = {("pos", "0 0 0"), ("quat", "1 0 0 0"), ("gear", "1")}


@dataclass
class Draft:
    """An MJCF file as XML elements."""

    model: Model  # the robot, with NumPy leaves
    root: ET.Element
    option: ET.Element
    world: ET.Element
    tendon: ET.Element
    equality: ET.Element
    actuator: ET.Element
    bodies: list[ET.Element] = field(default_factory=list)  # by index
    joints: list[ET.Element] = field(default_factory=list)  # by index
    geoms: dict[int, ET.Element] = field(default_factory=dict)  # by index, if written
    sites: list[str] = field(default_factory=list)
    tendons: list[str] = field(default_factory=list)
    springs: list[PointSpring] = field(default_factory=list)  # written as tendons, after the others
    notes: list[str] = field(default_factory=list)  # parts that are left out or differ

    @classmethod
    def of(cls, model: Model) -> Draft:
        """Make the empty file of a model."""
        root = ET.Element("mujoco", model="rbjax")
        # all inertias are explicit: none is computed from a shape
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
        """Return the element of a body, or of the world."""
        return self.world if index == WORLD else self.bodies[index]

    def add(self, body: int, tag: str, **attributes: str) -> ET.Element:
        """Add a joint, site or geom to a body, before its child bodies."""
        owner, element = self.body(body), ET.Element(tag, unusual(**attributes))
        owner.insert(next((i for i, x in enumerate(owner) if x.tag == "body"), len(owner)), element)
        return element

    def joint(self, index: int) -> str:
        """Return the name of a joint in the file."""
        return self.joints[index].get("name", "")

    def site(self, place: Place) -> str:
        """Return the name of the site at a place; add the site if there is none."""
        still = (np.asarray(place.orientation) == ALIGNED).all()
        if place.site is not None and still and not np.any(place.position):
            return self.sites[self.model.site(place.site)]
        body, p, quat = place_in_body(self.model, place)
        name = unique(["place"], self.sites)[0]
        self.sites.append(name)
        self.add(body, "site", name=name, pos=text(p), quat=text(quat))
        return name

    def note(self, what: str, names: Iterable[str] = ()) -> None:
        """Note a difference between the file and the model, once per text."""
        some = list(names)
        text = f"{what} ({listed(some)})" if some else what
        if text not in self.notes:
            self.notes.append(text)


def place_in_body(model: Model, place: Place) -> tuple[int, np.ndarray, np.ndarray]:
    """Return the body of a place, and its position and quaternion in the body's frame."""
    p, quat = (np.asarray(x, np.float64) for x in (place.position, place.orientation))
    if place.site is None:
        return (WORLD if place.body in (None, WORLD) else model.body(place.body)), p, quat
    site, own = model.site(place.site), model.sites
    at, turn = (np.asarray(x[site], np.float64) for x in (own.position, own.orientation))
    point, product = np.empty(3), np.empty(4)
    mujoco.mju_rotVecQuat(point, p, turn / np.linalg.norm(turn))
    mujoco.mju_mulQuat(product, turn, quat)
    return model.topology.site_bodies[site], at + point, product


def free_bodies(model: Model) -> set[int]:
    """Return the bodies on free joints. A file gives their frames at the joint's reference
    configuration."""
    top = model.topology
    kinds = zip(top.joint_bodies, top.joint_kinds, strict=True)
    return {body for body, kind in kinds if kind == "free"}


def unusual(**attributes: str) -> dict[str, str]:
    """Return the attributes that differ from MJCF's default."""
    return {key: x for key, x in attributes.items() if (key, x) not in _USUAL}


def text(x: Any) -> str:
    """Format numbers as the shortest decimals that are read as the same number in their dtype.

    >>> text(np.array([1.0, 0.1, -np.inf])), text(np.float32(0.1))
    ('1 0.1 -inf', '0.1')
    """
    return " ".join(str(n).removesuffix(".0") for n in np.ravel(np.asarray(x)))


def unique(names: Sequence[str], taken: Iterable[str] = ()) -> list[str]:
    """Make names unique by appending a number.

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
