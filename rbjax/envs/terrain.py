"""Rough ground: a height field in place of the floor of a robot file."""

from __future__ import annotations

from typing import Any
from xml.etree import ElementTree

import numpy as np

from rbjax.arguments import instance, integer, real_number
from rbjax.errors import ModelError


def rough_ground(
    xml: str,
    *,
    height: Any = 0.05,
    side: Any = 20.0,
    points: int = 256,
    seed: int = 0,
    friction: Any = None,
    floor: str = "floor",
) -> str:
    """Return the text of a robot file whose floor is a height field with random heights.

    The heights at the points of the grid are independent and uniform, scaled so that the least is 0
    and the greatest is `height`.

    Args:
        xml: text of an MJCF file with a geom `floor`.
        height: greatest height, m.
        side: length and width of the ground, m.
        points: points of the grid along each side.
        seed: of the heights, at least 0.
        friction: coefficient of friction of the ground; None for that of the floor.
        floor: name of the geom that is replaced.

    Raises:
        InputError: numbers out of range. ModelError: the text is not XML, no geom has the name.

    Source: the ground of MuJoCo Playground's rough terrains (Zakka et al., 2025).

    Example:
        >>> import rbjax as rb
        >>> floor = '<geom name="floor" type="plane" size="0 0 1"/>'
        >>> xml = f"<mujoco><worldbody>{floor}</worldbody></mujoco>"
        >>> rb.load(rb.envs.rough_ground(xml, points=16)).geoms.types
        ('hfield',)
    """
    where = "rough_ground"
    height = real_number(where, "height", height, above=0.0)
    side = real_number(where, "side", side, above=0.0)
    integer(where, "points", points, least=2)
    integer(where, "seed", seed, least=0)
    for name, x in (("xml", xml), ("floor", floor)):
        instance(where, name, x, str, "the text of an MJCF file" if name == "xml" else "a name")
    try:
        root = ElementTree.fromstring(xml)
    except ElementTree.ParseError as error:
        raise ModelError(
            f"{where}: the text is not well-formed XML ({error}), expected the text of an MJCF "
            "file, as pathlib.Path(file).read_text() returns it"
        ) from error
    geom = root.find(f".//geom[@name='{floor}']")
    if geom is None:
        raise ModelError(f"{where}: the file has no geom {floor!r}; name its floor by floor=")
    heights = np.random.default_rng(seed).uniform(size=(points, points))
    heights = (heights - heights.min()) / np.ptp(heights)
    geom.attrib.pop("size", None)
    geom.set("type", "hfield")
    geom.set("hfield", "ground")
    if friction is not None:
        geom.set("friction", f"{real_number(where, 'friction', friction, least=0.0)}")
    numbers = {"name": "ground", "nrow": f"{points}", "ncol": f"{points}"}
    numbers["size"] = f"{side / 2} {side / 2} {height} 1"
    numbers["elevation"] = " ".join(f"{x:.6f}" for x in heights.ravel())
    ElementTree.SubElement(ElementTree.SubElement(root, "asset"), "hfield", numbers)
    return ElementTree.tostring(root, encoding="unicode")
